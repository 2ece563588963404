"""A fit that knows the true structure: how good an answer could be."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.read import load

#: Efforts are each breath's own; the mean over those that were fitted is expected.
_EFFORT = ("patient_effort.amplitude", "patient_effort.onset")


def of_recording(path: Path, held_out: list[int], names: frozenset[str]) -> float:
    """:func:`rmse` of a recording in a file."""
    return rmse(load(path), held_out, names)


def rmse(breaths: Breaths, held_out: list[int], names: frozenset[str]) -> float:
    """Held-out open-loop RMSE over inspiratory samples of a fit with the true names, cmH2O.

    Each breath starts from its first reading. Nobody knows the effort of a breath to come: the mean
    over the efforts of the breaths that were fitted is expected.

    Args:
        breaths: the recording.
        held_out: ids of the breaths that the answer was judged by.
        names: mechanisms of the library that are in the rig.

    Raises:
        InputError: if no breath or every breath is held out.
    """
    from ventbench.physics.catalogue import parameter
    from ventbench.system_id import START, Simulator, fit, recorded, settings

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
    expected = [simulator.predict(values)]
    if set(_EFFORT) <= set(simulator.names):
        columns, expected = [simulator.names.index(path) for path in _EFFORT], []
        for effort in zip(*(found.column(path) for path in _EFFORT), strict=True):
            values[:, columns] = effort
            expected.append(simulator.predict(values))
    error = np.mean(expected, axis=0)[:, 0] - test.seen[:, 0]
    counted = (test.u_out < 0.5) & (test.weight[:, 0] > 0)
    counted[:, 0] = False  # where every simulation starts, and an answer is not judged either
    return float(np.sqrt(np.mean(error[counted] ** 2)))
