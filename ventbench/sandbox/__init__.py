"""Runs submissions apart: one locked-down process for each cell, joined by two pipes of numbers.

:class:`ventbench.sandbox.runner.SandboxRunner` is what a scorer uses. Who is who:

- the *scorer* (this process): simulators, targets, draws, clock; made unreadable to others while
  cells run;
- the *zygote* (:mod:`~ventbench.sandbox.child.zygote`): a new interpreter with numpy and nothing of
  the scorer's memory; starts cells by forking, runs no submitted code itself;
- a *cell*: forked from the zygote, locks itself down (:mod:`~ventbench.sandbox.child.lockdown`),
  only then imports the submission, answers one run of three breaths, ends.

This package imports nothing heavy: the zygote loads it too.
"""
