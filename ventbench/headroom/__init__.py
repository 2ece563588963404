"""How good a controller can be in a cell: best attainable commands, best PID, and their file.

- :mod:`~ventbench.headroom.attainable`: commands optimised for a cell, everything known, with a
  certificate;
- :mod:`~ventbench.headroom.best_pid`: the best PID of each lung over its rigs, and its errors;
- :mod:`~ventbench.headroom.reference`: both of them for the cells of a score, computed and stored.
"""
