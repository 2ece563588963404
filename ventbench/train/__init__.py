"""Learning simulators and controllers.

Entry points: :func:`~ventbench.train.pid_search.tune_pid`,
:func:`~ventbench.train.residual.train_residual`, :func:`~ventbench.train.rl.train.train_ppo`,
:func:`~ventbench.train.rl.train.train_dqn` and
:func:`~ventbench.train.rigs.train.train_rigs`.
Each one can be interrupted: called again with the same arguments it continues, to the same numbers.
"""
