"""Submissions: their format, how they are run, how they are scored.

- :mod:`~ventbench.submissions.folder`: find a submission and hash it;
- :mod:`~ventbench.submissions.manifest`: ``submission.toml``;
- :mod:`~ventbench.submissions.runner`: who runs the controllers (in this process, or a sandbox);
  one controller in one run is a :class:`ventbench.sandbox.child.cell.Cell` in both;
- :mod:`~ventbench.submissions.stepping`: the loop between plants and runner;
- :mod:`~ventbench.submissions.scoring`: the score, and :mod:`~ventbench.submissions.result` its
  form;
- :mod:`~ventbench.submissions.scaffold`: a new submission that scores at once;
- :mod:`~ventbench.submissions.contract`: everything that must hold before it is submitted, by
  reading (``file_checks``, ``manifest``, ``static_checks``) and by running (``contract_runs``);
- :mod:`~ventbench.submissions.errors`: what is wrong with a submission, in words for its author.
"""
