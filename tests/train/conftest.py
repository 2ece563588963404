"""Breaths of hybrid lungs whose parameters are known, in the place of recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.compilation import float64
from ventbench.plants.sessions import Sessions, find
from ventbench.recordings import Breaths, make_breaths
from ventbench.task.lungs import RECORDED_LUNGS, Lung
from ventbench.task.rollouts import open_loop
from ventbench.train.rigs.data import groups_of
from ventbench.train.rigs.fit import Pooled, centre, plants

SAMPLES, INSPIRATORY = 45, 30


def truth() -> Pooled:
    """What the synthetic lungs are: not where a fit starts. Call it in float64."""
    start = centre(RECORDED_LUNGS, len(RECORDED_LUNGS)).pooled
    return replace(
        start,
        slopes=start.slopes + jnp.linspace(0.5, -0.4, start.slopes.size),
        R=start.R + 0.3,
        K2=start.K2 - 0.2,
        E=start.E + 0.25 * (-1.0) ** jnp.arange(len(RECORDED_LUNGS)),
        offset=start.offset + 0.2,
        valve_delay=jnp.full_like(start.valve_delay, np.log(0.012)),
        conductance=jnp.full_like(start.conductance, np.log(0.3)),
    )


def synthetic(
    lungs: Sequence[Lung] = RECORDED_LUNGS, each: int = 3, *, seed: int = 0, first_id: int = 1
) -> Breaths:
    """Breaths under commands that are held for a few samples, all on one rig."""
    rng = np.random.default_rng(seed)
    n = len(lungs) * each
    R, C = (np.repeat([getattr(lung, name) for lung in lungs], each) for name in "RC")
    time = np.tile(0.033 * np.arange(SAMPLES), (n, 1))
    # Less for a stiff lung, so that all pressures are in the range of the recordings.
    top = 4.0 + 0.5 * np.minimum(C, 30.0)[:, None]
    u_in = np.repeat(rng.uniform(0.3, 1.0, (n, SAMPLES)) * top, 5, axis=1)[:, :SAMPLES]
    opened = np.broadcast_to(np.arange(SAMPLES) >= INSPIRATORY, u_in.shape) * 1.0
    u_in = np.where(opened > 0, 5.0, u_in)
    start = rng.uniform(4.5, 7.0, (n, 1)) * np.ones(u_in.shape)
    breaths = make_breaths(np.arange(n) + first_id, R, C, time, u_in, opened, start)
    with float64():
        plant = plants(truth(), groups_of(breaths, find(breaths), RECORDED_LUNGS))
        columns = (breaths.pressure[:, 0], u_in, opened, breaths.dt)
        pressure = open_loop(plant, *(jnp.asarray(x) for x in columns))
    return replace(breaths, pressure=np.array(pressure))


@pytest.fixture(scope="session")
def make_synthetic() -> Callable[..., Breaths]:
    return synthetic


@pytest.fixture(scope="session")
def known_sessions() -> Sessions:
    """Of all lungs, on the one rig of the synthetic breaths."""
    return find(synthetic(each=5))


@pytest.fixture(scope="session")
def true_parameters() -> Pooled:
    with float64():
        return truth()
