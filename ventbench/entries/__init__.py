"""Submissions: their format, how they are run, how they are scored.

- :mod:`~ventbench.entries.folder`: find a submission and hash it;
- :mod:`~ventbench.entries.manifest`: ``submission.toml``, and what is wrong with a submission;
- :mod:`~ventbench.entries.cells`: what is scored, against the bounds of
  :mod:`~ventbench.entries.reference`, who runs the controllers (in this process, or a sandbox), and
  the loop between plants and runner; one controller in one run is a
  :class:`ventbench.sandbox.child.cell.Cell` in both;
- :mod:`~ventbench.entries.scoring`: the score, :mod:`~ventbench.entries.runs` the figures of its
  runs, and :mod:`~ventbench.entries.result` its form;
- :mod:`~ventbench.entries.scaffold`: a new submission that scores at once;
- :mod:`~ventbench.entries.contract`: everything that must hold before it is submitted, by
  reading (``folder``, ``manifest``, ``review``) and by running (``contract``).
"""
