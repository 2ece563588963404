"""Simulators of rigs: a hierarchical fit to recordings of many ventilators and lungs."""
