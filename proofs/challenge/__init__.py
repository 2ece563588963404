"""Sealed challenges: recordings with concealed effects, answers to them, and their scores.

The rig that makes the recordings shares no code with :mod:`ventbench.physics`: it uses other
equations where there is a choice, another integrator, and numpy only. A hash of what it conceals is
published first; the seed reveals the rest.
"""
