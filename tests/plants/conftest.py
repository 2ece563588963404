"""Breaths without recordings, for what looks at commands and clocks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ventbench.recordings import Breaths, make_breaths
from ventbench.task.lungs import lung

#: Samples of a breath; about as many as the recordings have.
SAMPLES = 80


def breaths_of(
    lungs: list[str],
    interval_ms: float | list[float] = 33.0,
    *,
    inspiratory: int | list[int] = 30,
    late: float | list[float] = 0.0,
    seed: int = 0,
) -> Breaths:
    """Breaths under random commands, their pressures 5 cmH2O and noise.

    Args:
        lungs: id of each.
        interval_ms: median sampling interval, ms, one or one a breath; so are the others.
        inspiratory: number of inspiratory samples.
        late: share of intervals that are 2 ms longer.
        seed: of commands and pressures.
    """
    rng = np.random.default_rng(seed)
    n = len(lungs)
    interval, count, share = (
        np.broadcast_to(x, n)[:, None] for x in (interval_ms, inspiratory, late)
    )
    # Late samples are spread evenly, so that their share is exact.
    place = np.arange(SAMPLES - 1)
    spread = np.floor((place + 1) * share) > np.floor(place * share)
    dt = (interval + 2.0 * spread) / 1000.0
    shape = (n, SAMPLES)
    return make_breaths(
        np.arange(n) + 1,
        [lung(x).R for x in lungs],
        [lung(x).C for x in lungs],
        np.concatenate([np.zeros((n, 1)), np.cumsum(dt, axis=1)], axis=1),
        rng.uniform(0.0, 15.0, shape),
        np.broadcast_to(np.arange(SAMPLES) >= count, shape),
        5.0 + rng.uniform(0.0, 10.0, shape),
    )


@pytest.fixture
def make_recording() -> Callable[..., Breaths]:
    return breaths_of
