"""ventbench: the benchmark for mechanical-ventilator control."""

__version__ = "0.1.0"
