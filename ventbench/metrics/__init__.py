"""Metrics of pressures and commands in numpy: float64, vectorised over any batch shape.

- :mod:`~ventbench.metrics.open_loop`: distance of a simulator to recordings;
- :mod:`~ventbench.metrics.waveform`: the score;
- :mod:`~ventbench.metrics.step_response`: rise, overshoot, settling, steady error, ringing;
- :mod:`~ventbench.metrics.effort`: control effort and clipping;
- :mod:`~ventbench.metrics.safety`: time above a limit, the safety gate;
- :mod:`~ventbench.metrics.figures`: the registry of secondary figures of a score;
- :mod:`~ventbench.metrics.bootstrap`: mean, median and interval over breaths or draws.

NaN never hides: a figure that does not exist (a rise that never happened) is NaN here and null in
JSON, and a NaN pressure gives a NaN figure.
"""
