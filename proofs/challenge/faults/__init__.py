"""A third generator of concealed recordings: what goes wrong in laboratories and at the bedside.

A plain lung behind a plain valve, and faults of the recording, of the session and of the circuit,
some of which act in a few breaths or above a pressure only. Written from the literature named in
:mod:`~proofs.challenge.faults.effects`; it shares no equation with :mod:`ventbench.physics` or with
the other generators.
"""
