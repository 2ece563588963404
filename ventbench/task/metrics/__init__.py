"""Metrics of pressures and commands in numpy: float64, vectorised over any batch shape.

- :mod:`~ventbench.task.metrics.open_loop`: distance of a simulator to recordings;
- :mod:`~ventbench.task.metrics.score`: the score, the safety gate, and the secondary figures: rise,
  overshoot, settling, ringing, effort, alarm;
- :mod:`~ventbench.task.metrics.bootstrap`: mean, median and interval over breaths or draws.

NaN never hides: a figure that does not exist (a rise that never happened) is NaN here and null in
JSON, and a NaN pressure gives a NaN figure.
"""
