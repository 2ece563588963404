"""How good a controller can be in a cell: best attainable commands and best PID.

- :mod:`~ventbench.headroom.attainable`: commands optimised for a cell, everything known, with a
  certificate;
- :mod:`~ventbench.headroom.reference`: that and the lung's best PID for all cells of a score,
  computed, stored and checked. The PIDs are found by :mod:`ventbench.train.pid_grid`.
"""
