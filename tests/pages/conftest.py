"""Synthetic runs: a PID on the textbook lung, through the real protocol."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.controllers.pid import PID
from ventbench.plants.single_compartment import single_compartment
from ventbench.task import environment, lungs, protocol, rollouts, waveform
from ventbench.trajectories import Trajectories

#: Best of the paper's grid with D = 0 on these lungs: one a lung, one for all.
BEST = {
    "R5C10": (10.0, 0.0),
    "R5C20": (6.0, 10.0),
    "R5C50": (7.0, 10.0),
    "R20C10": (1.0, 10.0),
    "R20C20": (1.0, 10.0),
    "R20C50": (1.0, 10.0),
}
ROBUST = dict.fromkeys(BEST, (1.0, 10.0))
SHAPE = (len(lungs.LUNGS), len(protocol.PIPS), protocol.BREATHS * protocol.BREATH_STEPS)


def simulate(name: str, gains: Mapping[str, tuple[float, float]]) -> Trajectories:
    pressure, u_in = np.empty(SHAPE), np.empty(SHAPE)
    for i, lung in enumerate(lungs.LUNGS):
        with compilation.float64():
            cells = environment.nominal_scenario(protocol.PIPS)
            inspired, expired = rollouts.closed_loop(
                single_compartment(lung), PID(*gains[lung.id]), cells, whole=True
            )
        assert expired is not None
        for array, part in ((pressure, "pressure"), (u_in, "u_in")):
            both = [getattr(inspired, part), getattr(expired, part)]
            array[i] = np.concatenate(both, axis=-1).reshape(SHAPE[1:])
    steps = np.arange(SHAPE[-1])
    target = waveform.target(steps, np.asarray(protocol.PIPS)[:, None])
    u_out = (steps % protocol.BREATH_STEPS >= protocol.INSPIRATION_STEPS).astype(float)
    return Trajectories(
        name=name,
        track="performance",
        lungs=lungs.LUNG_IDS,
        pips=protocol.PIPS,
        time=np.arange(SHAPE[-1], dtype=np.float64) * protocol.DT,
        target=np.broadcast_to(target, SHAPE),
        pressure=pressure,
        u_in=u_in,
        u_out=np.broadcast_to(u_out, SHAPE),
    )


@pytest.fixture(scope="session")
def best() -> Trajectories:
    return simulate("pid_best", BEST)


@pytest.fixture(scope="session")
def robust() -> Trajectories:
    return simulate("pid_robust", ROBUST)


@pytest.fixture(scope="session")
def failed(robust: Trajectories) -> Trajectories:
    """A run whose second lung has gaps, under a name that attacks."""
    pressure = robust.pressure.copy()
    pressure[1, 2, 150:] = np.nan
    pressure[1, 3, 250] = np.inf
    name = "<script>alert('x')</script> $ ![i](http:\u673a\u202e & long enough to be cut"
    return dataclasses.replace(robust, name=name, pressure=pressure)
