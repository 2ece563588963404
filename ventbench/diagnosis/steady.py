"""A simulator whose own physics stay what they are, but for what it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ventbench.diagnosis.bench import Bench, by_label
from ventbench.diagnosis.found import Found
from ventbench.diagnosis.gate import LITTLE, WEAK, believed
from ventbench.diagnosis.hypothesis import Hypothesis, has_own
from ventbench.diagnosis.solved import Side, Solved
from ventbench.physics.catalogue import mechanism
from ventbench.system_id import Fit, fit
from ventbench.system_id.unknowns import described, freed


def steadied(
    found: Found, had: Found, missing: Sequence[str]
) -> tuple[Found, tuple[str, ...]] | None:
    """Fit what a simulator lacks beside the rest of its physics as they are.

    What is refitted in every hypothesis, so that names can be believed, is not what must be wrong
    with a simulator: on a few breaths each R and C goes somewhere, and held-out breaths pay for it.

    Args:
        found: in the recording.
        had: in the simulator.
        missing: mechanisms that the simulator lacks, or has with other parameters.

    Returns:
        The same conclusion with the simulator's own R, C, R_ex, PEEP and other mechanisms, and the
        mechanisms that are missing then; None if held-out breaths ask for others.
    """
    full, own = found.conclusion.full, had.conclusion.full
    if any(has_own(name) for name in (*full.names, *own.names)):
        return None
    place = found.conclusion.place
    element = (place.element,) if place is not None and place.element else ()
    bench = _widest(found.bench, had.bench)

    def having(names: Sequence[str]) -> tuple[Fit, Solved]:
        asked = (*names, *element)
        hypothesis = _of(full.hypothesis, own.hypothesis, asked)
        one = _fitted(bench, hypothesis, asked, full, own)
        likelihood = float(one.problem.log_likelihood(one.minimum.x).sum())
        return one, Solved(hypothesis, one.problem, one.minimum, likelihood)

    names, (one, solved) = tuple(missing), having(missing)
    if believed(found.bench.judged(full) - bench.judged(solved)):
        return None
    nothing = bench.judged(having(())[1])
    while names:
        # What only trimmed another R or C is idle beside the simulator's own.
        fewer = [(name, *having([other for other in names if other != name])) for name in names]
        lost = [bench.judged(solved) - bench.judged(less) for _, _, less in fewer]
        least = int(np.argmin([nats.sum() for nats in lost]))
        name, one_less, less = fewer[least]
        whole = float((bench.judged(solved) - nothing).sum())
        trace = is_faint(solved, own, name) and lost[least].sum() < LITTLE * whole
        if believed(lost[least]) and not trace:
            break
        one, solved = one_less, less
        names = tuple(other for other in names if other != name)
    return Found(bench, replace(found.conclusion, full=solved), one), names


def is_faint(solved: Solved, own: Solved, name: str) -> bool:
    """Whether a mechanism is by far less than a mild one beyond what the simulator has of it."""
    item = mechanism(name).description.strength
    path = f"{name}.{item.name}"
    beyond = np.abs(solved.column(path) - own.column(path)[0])
    return bool(beyond.max() < WEAK * abs(item.mild - item.neutral))


def _of(full: Hypothesis, own: Hypothesis, asked: tuple[str, ...]) -> Hypothesis:
    """What is asked for as the recording has it, and the rest as the simulator has it."""
    needless = [name for name in full.names if name not in asked]
    return own.without(*asked).plus(full.without(*needless))


def _fitted(
    bench: Bench, hypothesis: Hypothesis, asked: tuple[str, ...], full: Solved, own: Solved
) -> Fit:
    side = bench.training
    names = side.simulator.names
    values = bench.carried(own, side)
    free = [p for p in (*freed(asked), *hypothesis.free) if p.rpartition(".")[0] in asked]
    fixed: dict[str, ArrayLike] = {
        name: values[:, k] for k, name in enumerate(names) if name not in (*free, "position")
    }
    given = {p: x for p, x in hypothesis.fixed if p.rpartition(".")[0] in asked}
    loose = ("gain",) if bench.spread else ()
    neutral = float(np.log(described("gain").neutral))
    return fit(
        side.data, hypothesis.names, free=(*free, *loose),
        fixed={p: x for p, x in (fixed | given).items() if p not in loose},
        start={p: float(np.median(full.column(p))) for p in free},
        groups=by_label(side.data, tuple(free)) | {p: np.arange(len(side.data)) for p in loose},
        prior={p: (neutral, bench.spread) for p in loose},
        noise=full.noise, simulator=side.simulator,
    )  # fmt: skip


def _widest(found: Bench, had: Bench) -> Bench:
    """The recording on the bench whose simulator knows everything that either needs."""
    if len(found.training.simulator.names) >= len(had.training.simulator.names):
        return found
    return replace(
        found,
        training=Side(found.training.data, had.training.simulator),
        judging=Side(found.judging.data, had.judging.simulator),
    )
