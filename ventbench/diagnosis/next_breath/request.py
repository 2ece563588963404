"""Choose the breaths that tell hypotheses apart best, among those that are safe under all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis.next_breath.candidates import Family, Rig, families
from ventbench.diagnosis.next_breath.information import (
    Contrast,
    Fitted,
    acting,
    contrast,
    forecast,
    values_of,
)
from ventbench.diagnosis.result import Request
from ventbench.lungs import Lung
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START, Simulator
from ventbench.system_id.noise import Noise

#: Pressure, cmH2O, within which every hypothesis must expect a breath to stay: 0 to 50, give or
#: take what the noise of a starting pressure does.
SAFE = (-1.0, 50.0)

#: Nats below which new breaths would not tell the hypotheses apart.
LEAST = 1.0

#: A breath that is not safe is tried this much weaker, so often.
_WEAKER, _TRIES = 0.75, 3


@dataclass(frozen=True, eq=False)
class _Choice:
    nats: float
    families: tuple[Family, ...]
    members: tuple[tuple[int, ...], ...]
    lung: Lung


def request(
    chosen: Fitted,
    alternatives: Sequence[Fitted],
    *,
    noise: Noise | None = None,
    breaths: int = 5,
) -> Request | None:
    """Find the breaths to record next.

    For each kind of breath and each mix of two kinds: what is expected to be lost, in nats, if one
    hypothesis is true and the other one is refitted to recorded and new breaths together; both
    ways, for each alternative. The least of these counts.

    Args:
        chosen: the best hypothesis; its recording and simulator count for all.
        alternatives: what it shall be told from.
        noise: of the measurement; that of ``chosen`` if not given.
        breaths: to record.

    Returns:
        Commands with what to do in words, or None if no safe breaths would tell them apart.
    """
    if not alternatives:
        return None
    noise, data = noise or chosen.problem.noise, chosen.problem.data
    best: _Choice | None = None
    for label in np.unique(data.lung):
        here = np.flatnonzero((data.lung == label) & (data.weight[:, 0].any(axis=1)))
        if not here.size:
            continue
        found = _on_lung(chosen, alternatives, noise, breaths, here)
        if found and (best is None or found.nats > best.nats):
            best = found
    if best is None or best.nats < LEAST:
        return None
    return _worded(best, (chosen, *alternatives), float(np.median(data.dt)))


def _on_lung(
    chosen: Fitted, alternatives: Sequence[Fitted], noise: Noise, breaths: int,
    here: NDArray[np.intp],
) -> _Choice | None:  # fmt: skip
    """The best choice on the lung of the recorded breaths ``here``."""
    problem = chosen.problem
    values = problem.values(chosen.minimum.x)[here]
    columns = (*problem.simulator.names, START)
    rig = Rig(*(float(np.median(values[:, columns.index(n)])) for n in ("R", "C", "gain", "PEEP")))
    start = float(np.median(values[:, -1]))
    samples, dt = problem.data.u_in.shape[1], float(np.median(problem.data.dt))
    every = (chosen, *alternatives)
    kinds = _safe(families(rig, samples, dt), every, problem.data, here, start)
    if not kinds:
        return None
    data = _data(kinds, problem.data, here)
    simulator = Simulator(data, problem.simulator.names, problem.simulator.substeps)
    expected = [forecast(item, data, simulator, here, start, noise) for item in every]
    pairs = [
        found
        for other in expected[1:]
        for found in (
            contrast(expected[0], other, noise),
            contrast(other, expected[0], noise),
        )
    ]
    lung = Lung(float(problem.data.R[here[0]]), float(problem.data.C[here[0]]))
    return _best(kinds, pairs, breaths, lung)


def _best(
    kinds: tuple[Family, ...], pairs: Sequence[Contrast], breaths: int, lung: Lung
) -> _Choice | None:
    """The kind or mix of two with the largest of the smallest nats."""
    ends = np.cumsum([len(kind.u_in) for kind in kinds])
    firsts = ends - [len(kind.u_in) for kind in kinds]
    sets = [(i,) for i in range(len(kinds))] + list(combinations(range(len(kinds)), 2))
    best = None
    for chosen in sets:
        counts = [breaths] if len(chosen) == 1 else [breaths - breaths // 2, breaths // 2]
        members = tuple(
            tuple(np.linspace(0, len(kinds[i].u_in) - 1, count).round().astype(int).tolist())
            for i, count in zip(chosen, counts, strict=True)
        )
        which = [firsts[i] + np.array(m, int) for i, m in zip(chosen, members, strict=True)]
        nats = min(pair.nats(np.concatenate(which)) for pair in pairs)
        if best is None or nats > best.nats:
            best = _Choice(nats, tuple(kinds[i] for i in chosen), members, lung)
    return best


def _safe(
    kinds: tuple[Family, ...], hypotheses: Sequence[Fitted], recorded: Data,
    here: NDArray[np.intp], start: float,
) -> tuple[Family, ...]:  # fmt: skip
    """Breaths that every hypothesis expects within :data:`SAFE`, if need be weakened."""
    for attempt in range(_TRIES + 1):
        data = _data(kinds, recorded, here)
        safe = np.ones(len(data), bool)
        for item in hypotheses:
            simulator = Simulator(
                data, item.problem.simulator.names, item.problem.simulator.substeps
            )
            pressure = simulator.predict(values_of(item, data, here, start))[:, 0]
            inside = (pressure >= SAFE[0]) & (pressure <= SAFE[1])  # False where it is not finite
            safe &= inside.all(axis=1)
        parts = np.split(safe, np.cumsum([len(kind.u_in) for kind in kinds])[:-1])
        if safe.all() or attempt == _TRIES:
            break
        kinds = tuple(
            kind.scaled(np.where(part, 1.0, _WEAKER))
            for kind, part in zip(kinds, parts, strict=True)
        )
    left = (kind.select(part) for kind, part in zip(kinds, parts, strict=True))
    return tuple(kind for kind in left if len(kind.u_in))


def _data(kinds: Sequence[Family], recorded: Data, here: NDArray[np.intp]) -> Data:
    """The breaths of all kinds as data without readings, on the lung of recorded breaths."""
    u_in = np.concatenate([kind.u_in for kind in kinds])
    u_out = np.concatenate([kind.u_out for kind in kinds])
    count, channels = len(u_in), recorded.seen.shape[1]
    shape = (count, channels, u_in.shape[1])
    weight = np.ones(shape)
    weight[:, 1:, 0] = 0.0
    ones: Floats = np.ones(count)
    return Data(
        u_in, u_out, np.full(u_in.shape, float(np.median(recorded.dt))), np.zeros(shape), weight,
        recorded.R[here[0]] * ones, recorded.C[here[0]] * ones, ones,
    )  # fmt: skip


def _worded(choice: _Choice, hypotheses: Sequence[Fitted], dt: float) -> Request:
    parts = [
        f"{len(members)} x {kind.title}"
        for kind, members in zip(choice.families, choice.members, strict=True)
    ]
    pairs = list(zip(choice.families, choice.members, strict=True))
    u_in = np.concatenate([kind.u_in[list(members)] for kind, members in pairs])
    u_out = np.concatenate([kind.u_out[list(members)] for kind, members in pairs])
    acts = [acting(item) for item in hypotheses]
    common = set(acts[0]).intersection(*acts[1:])
    names = [" + ".join(n for n in own if n not in common) or "nothing more" for own in acts]
    return Request(
        f"{'; '.join(parts)} (lung {choice.lung.id})", tuple(dict.fromkeys(names)), choice.nats,
        u_in, u_out, np.full(u_in.shape, dt),
    )  # fmt: skip
