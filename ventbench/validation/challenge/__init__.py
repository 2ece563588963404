"""Recordings with concealed effects, by a simulator of its own, and scores of what finds them.

The rig shares no code with :mod:`ventbench.physics`: other equations where there is a choice,
another integrator, numpy only. What it conceals is published as a hash first and revealed with its
seed.
"""
