"""How much of an effect is to be seen at all, after R, C, R_ex, PEEP and starts are refitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ventbench.recordings.breaths import Breaths
from ventbench.validation.challenge.cases import Base, Case
from ventbench.validation.challenge.rig import replay

Floats = NDArray[np.float64]

#: Breaths that are looked at, spread over the recording.
_LOOKED_AT = 8

#: An effect worth less than this many nats in all breaths of a recording may be passed over in
#: silence: a fifth of them, held out, would hardly raise a likelihood by log 100.
LIMIT = 25.0

_KEYS = ("R", "C", "R_ex", "peep")
_STEP = 1e-3


def nats(case: Case, breaths: Breaths, index: int) -> float:
    """Expected log-likelihood that is lost without one effect, over all breaths of a recording.

    The rig itself, without that effect, is fitted to what it gives with it, under the recorded
    commands and without noise; what remains is divided by the noise. A patient's efforts are other
    ones than in the recording.

    Args:
        case: with its base.
        breaths: its recording.
        index: of the effect among the case's.
    """
    assert case.base is not None
    count = min(_LOOKED_AT, len(breaths))
    some = breaths.select(np.linspace(0, len(breaths) - 1, count).astype(int))
    start = np.full(count, case.base.peep)
    seen = replay(case, some, start, seed=index)
    rest = replace(case, effects=case.effects[:index] + case.effects[index + 1 :])
    error = _refitted(rest, case.base, some, start, seen, seed=index)
    noise = max(case.noise**2 + case.step**2 / 12.0, 1e-6)
    return float(0.5 * np.sum(error**2) / noise * len(breaths) / count)


def _refitted(
    case: Case, base: Base, breaths: Breaths, start: Floats, seen: Floats, seed: int
) -> Floats:
    """Residuals of the best rig, by Gauss-Newton steps that are halved until they help."""

    def run(at: Base, first: Floats) -> Floats:
        return seen - replay(replace(case, base=at), breaths, first, seed)

    error = run(base, start)
    for _ in range(6):
        moved = [run(_changed(base, key, _STEP), start) for key in _KEYS]
        slopes = np.stack([(error - m) / _STEP for m in moved])
        own = (error - run(base, start + _STEP)) / _STEP
        size = np.sum(own**2, axis=1)
        along = np.einsum("knt,nt->kn", slopes, own) / size
        apart = slopes - along[:, :, None] * own
        left = error - (np.sum(error * own, axis=1) / size)[:, None] * own
        step = np.linalg.lstsq(apart.reshape(len(_KEYS), -1).T, left.ravel(), rcond=None)[0]
        shift = np.sum((error - np.tensordot(step, slopes, 1)) * own, axis=1) / size
        better = None
        for share in (1.0, 0.5, 0.25):
            tried, first = base, start + share * shift
            for key, value in zip(_KEYS, step, strict=True):
                tried = _changed(tried, key, share * float(np.clip(value, -0.7, 0.7)))
            left = run(tried, first)
            if np.sum(left**2) < np.sum(error**2):
                better = tried, first, left
                break
        if better is None:
            break
        gain = 1.0 - np.sum(better[2] ** 2) / np.sum(error**2)
        base, start, error = better
        if gain < 0.1:
            break
    return error


def _changed(base: Base, key: str, by: float) -> Base:
    """The rig with one value changed: by a factor exp(by), PEEP by so many cmH2O."""
    old = getattr(base, key)
    return replace(base, **{key: old + by if key == "peep" else old * float(np.exp(by))})
