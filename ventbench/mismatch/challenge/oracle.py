"""A fit that knows the true structure: how good an answer could be."""

from __future__ import annotations

import numpy as np

from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths


def rmse(breaths: Breaths, held_out: list[int], names: frozenset[str]) -> float:
    """Held-out open-loop RMSE over inspiratory samples of a fit with the true names, cmH2O.

    Each breath starts from its first reading; what is a breath's own is neutral, as nobody knows
    it before the breath.

    Args:
        breaths: the recording.
        held_out: ids of the breaths that the answer was judged by.
        names: mechanisms of the library that are in the rig.

    Raises:
        InputError: if no breath or every breath is held out.
    """
    from ventbench.physics.catalogue import parameter
    from ventbench.physics.fits import START, Simulator, fit, recorded, settings

    apart = np.isin(breaths.breath_id, held_out)
    if not apart.any() or apart.all():
        raise InputError(f"{apart.sum()} of {len(apart)} breaths are held out; both are needed")
    data = recorded(breaths)
    found = fit(data.select(~apart), sorted(names))
    test = data.select(apart)
    simulator = Simulator(test, found.problem.simulator.names)
    values = settings(test, simulator.names, {})
    for column, name in enumerate(simulator.names):
        own = "." in name and parameter(name).scope == "breath"
        if name != "position" and name != START and not own:
            values[:, column] = found.column(name)[0]
    error = simulator.predict(values)[:, 0] - test.seen[:, 0]
    counted = (test.u_out < 0.5) & (test.weight[:, 0] > 0)
    return float(np.sqrt(np.mean(error[counted] ** 2)))
