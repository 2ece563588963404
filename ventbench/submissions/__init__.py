"""Submissions: their format, how they are run, how they are scored.

- :mod:`~ventbench.submissions.folder`: find a submission and hash it;
- :mod:`~ventbench.submissions.manifest`: ``submission.toml``;
- :mod:`~ventbench.submissions.load`: import ``controller.py``;
- :mod:`~ventbench.submissions.cell`: one controller in one run, and every way in which it fails;
- :mod:`~ventbench.submissions.runner`: who runs the controllers (in this process, or a sandbox);
- :mod:`~ventbench.submissions.stepping`: the loop between plants and runner;
- :mod:`~ventbench.submissions.scoring`: the score, and :mod:`~ventbench.submissions.result` its
  form;
- :mod:`~ventbench.submissions.scaffold`: a new submission that scores at once;
- :mod:`~ventbench.submissions.contract`: everything that must hold before it is submitted, by
  reading (``folder_check``, ``weights_check``, ``manifest_check``, ``source_check``) and by running
  (``contract_runs``, ``dry_run``, ``judgement``); :mod:`~ventbench.submissions.findings` its form.
"""
