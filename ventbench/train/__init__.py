"""Learning simulators and controllers.

Entry points: :func:`~ventbench.train.pid_search.tune_pid`,
:func:`~ventbench.train.rl.train.train_networks` and :func:`~ventbench.train.rigs.train.train_rigs`.
The last two can be interrupted: called again with the same arguments they continue, to the same
numbers. The learner of an entry stands beside it, in ``submissions/NAME/train.py``.
"""
