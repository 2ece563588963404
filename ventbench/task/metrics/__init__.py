"""Metrics of pressures and commands in numpy: float64, vectorised over any batch shape.

- :mod:`~ventbench.task.metrics.open_loop`: distance of a simulator to recordings;
- :mod:`~ventbench.task.metrics.score`: the score and the safety gate;
- :mod:`~ventbench.task.metrics.figures`: rise, overshoot, settling, ringing, effort, alarm: all
  secondary figures of a score;
- :mod:`~ventbench.task.metrics.bootstrap`: mean, median and interval over breaths or draws.

NaN never hides: a figure that does not exist (a rise that never happened) is NaN here and null in
JSON, and a NaN pressure gives a NaN figure.
"""
