"""How well simulators meet recordings: the open-loop test over files of any size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import precision
from ventbench.metrics import bootstrap, open_loop
from ventbench.plants.base import Plant
from ventbench.recordings import Breaths
from ventbench.rollout import open_loop as roll

Floats = NDArray[np.float64]

#: Gives the plants of some breaths: parameters of shape ``(n, ...)``.
PlantsFor = Callable[[Breaths], Plant]

# Breaths rolled out together: bounds memory, and the last batch is padded so that all compile once.
_BATCH = 4096


def pressures(plants_for: PlantsFor, breaths: Breaths) -> Floats:
    """Open-loop answers to recorded commands, from each breath's first pressure.

    Args:
        plants_for: see :data:`PlantsFor`.
        breaths: n breaths of T samples.

    Returns:
        cmH2O, shape ``(n, T)``; NaN for a breath whose first pressure is blank.
    """
    n = len(breaths)
    batch = min(_BATCH, n)
    parts = []
    with precision.float64():
        for first in range(0, n, batch):
            index = np.minimum(np.arange(first, first + batch), n - 1)
            part = breaths.select(index)
            columns = (part.pressure[:, 0], part.u_in, part.u_out, part.dt)
            start, *commands = (jnp.asarray(x, float) for x in columns)
            answer = roll(plants_for(part), start, *commands)
            parts.append(np.asarray(answer)[: min(batch, n - first)])
    return np.concatenate(parts)


def errors(plants_for: PlantsFor, breaths: Breaths) -> Floats:
    """Open-loop MAE of each breath over its inspiratory samples, cmH2O, shape ``(n,)``.

    NaN where a breath has no first pressure or no other inspiratory one.
    """
    simulated = pressures(plants_for, breaths)
    blank = np.isnan(breaths.pressure[:, 0])
    found = open_loop.mae(breaths.pressure, np.nan_to_num(simulated), breaths.inspiratory)
    return np.where(blank, np.nan, found)


#: A breath is looked at more closely if its error exceeds this, cmH2O ...
SUSPECT = 1.0

#: ... and does not fit its label if another explanation leaves less than this share of its error.
FAR_BETTER = 0.4

#: Factors on the flow of the valve that are tried as explanations.
GAINS = (0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6)


@dataclass(frozen=True)
class Misfit:
    """A breath that something else than its label explains far better.

    Attributes:
        breath_id: of the recording.
        lung: its label.
        mae: under its label, cmH2O.
        explanation: such as ``"lung R20C20"`` or ``"valve gain x 0.8"``.
        mae_explained: under the explanation, cmH2O.
    """

    breath_id: int
    lung: str
    mae: float
    explanation: str
    mae_explained: float


def misfits(
    plants_for: PlantsFor,
    with_gain: Callable[[Any, float], Plant],
    breaths: Breaths,
    error: Floats,
    settings: tuple[tuple[float, float], ...],
) -> list[Misfit]:
    """Find breaths that do not fit their label.

    Each suspect breath is simulated once more as every other lung setting and with each of
    :data:`GAINS`; nothing is fitted to it.

    Args:
        plants_for: see :data:`PlantsFor`.
        with_gain: returns plants whose valve gives a multiple of its flow.
        breaths: n breaths.
        error: of each under its label, cmH2O, shape ``(n,)``.
        settings: the (R, C) that are tried.
    """
    index = np.flatnonzero(error > SUSPECT)
    if index.size == 0:
        return []
    suspects = breaths.select(index)
    names, found = [], []
    for r, c in settings:
        other = replace(suspects, R=np.full(index.size, r), C=np.full(index.size, c))
        names.append(f"lung R{r:g}C{c:g}")
        found.append(errors(plants_for, other))
    for gain in GAINS:
        names.append(f"valve gain x {gain:g}")
        found.append(errors(lambda part, gain=gain: with_gain(plants_for(part), gain), suspects))
    best = np.argmin(found, axis=0)
    least = np.min(found, axis=0)
    return [
        Misfit(
            int(suspects.breath_id[i]),
            str(suspects.lung_ids[i]),
            float(error[index[i]]),
            names[best[i]],
            float(least[i]),
        )
        for i in np.flatnonzero(least < FAR_BETTER * error[index])
    ]


def summary(prefix: str, error: Floats) -> dict[str, Any]:
    """Figures of some breaths.

    Args:
        prefix: of the keys, such as ``"held_out_"``.
        error: of each breath, cmH2O, shape ``(n,)``; NaN for one that could not be judged.

    Returns:
        JSON values: ``mae``, ``median_mae``, ``ci95`` (bootstrap interval of the mean) and
        ``breaths``, with the prefix; null where there is no breath.
    """
    found = bootstrap.summary(error)
    return {
        f"{prefix}mae": _number(found.mean),
        f"{prefix}median_mae": _number(found.median),
        f"{prefix}ci95": [_number(limit) for limit in found.ci95],
        f"{prefix}breaths": found.count,
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
