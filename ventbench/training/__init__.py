"""Learning simulators and controllers.

Entry points: :func:`~ventbench.training.pid_grid.tune_pid`,
:func:`~ventbench.training.residual.train_residual`, :func:`~ventbench.training.rl.train.train_ppo`,
:func:`~ventbench.training.rl.train.train_dqn` and
:func:`~ventbench.training.rigs.train.train_rigs`.
Each one can be interrupted: called again with the same arguments it continues, to the same numbers.
"""
