"""A simulator whose own physics stay what they are, but for what it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ventbench.diagnosis.evaluator import Evaluator, groups_by_label
from ventbench.diagnosis.found import Found
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, Partition, varies_by_breath
from ventbench.diagnosis.selection import passes_heldout_test
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
    if any(varies_by_breath(name) for name in (*full.names, *own.names)):
        return None
    place = found.conclusion.unnamed
    element = (place.term,) if place is not None and place.term else ()
    evaluator = _widest(found.evaluator, had.evaluator)
    settings = evaluator.settings.held_out_test

    def having(names: Sequence[str]) -> tuple[Fit, FittedModel]:
        asked = (*names, *element)
        hypothesis = _of(full.hypothesis, own.hypothesis, asked)
        one = _fitted(evaluator, hypothesis, asked, full, own)
        likelihood = float(one.problem.log_likelihood(one.minimum.x).sum())
        return one, FittedModel(hypothesis, one.problem, one.minimum, likelihood)

    names, (one, fitted) = tuple(missing), having(missing)
    if passes_heldout_test(
        found.evaluator.held_out_log_likelihood(full) - evaluator.held_out_log_likelihood(fitted),
        settings,
    ):
        return None
    nothing = evaluator.held_out_log_likelihood(having(())[1])
    while names:
        # What only trimmed another R or C is idle beside the simulator's own.
        fewer = [(name, *having([other for other in names if other != name])) for name in names]
        lost = [
            evaluator.held_out_log_likelihood(fitted) - evaluator.held_out_log_likelihood(less)
            for _, _, less in fewer
        ]
        least = int(np.argmin([nats.sum() for nats in lost]))
        name, one_less, less = fewer[least]
        whole = float((evaluator.held_out_log_likelihood(fitted) - nothing).sum())
        faint = is_faint(fitted, own, name, settings.negligible_strength)
        trace = faint and lost[least].sum() < settings.negligible_share * whole
        if passes_heldout_test(lost[least], settings) and not trace:
            break
        one, fitted = one_less, less
        names = tuple(other for other in names if other != name)
    return Found(evaluator, replace(found.conclusion, full=fitted), one), names


def is_faint(fitted: FittedModel, own: FittedModel, name: str, share: float) -> bool:
    """Whether a mechanism is by far less than a mild one beyond what the simulator has of it."""
    item = mechanism(name).description.strength
    path = f"{name}.{item.name}"
    beyond = np.abs(fitted.column(path) - own.column(path)[0])
    return bool(beyond.max() < share * abs(item.mild - item.neutral))


def _of(full: Hypothesis, own: Hypothesis, asked: tuple[str, ...]) -> Hypothesis:
    """What is asked for as the recording has it, and the rest as the simulator has it."""
    needless = [name for name in full.names if name not in asked]
    return own.without(*asked).plus(full.without(*needless))


def _fitted(
    evaluator: Evaluator,
    hypothesis: Hypothesis,
    asked: tuple[str, ...],
    full: FittedModel,
    own: FittedModel,
) -> Fit:
    partition = evaluator.training
    names = partition.simulator.names
    values = evaluator.transferred_values(own, partition)
    free = [p for p in (*freed(asked), *hypothesis.free) if p.rpartition(".")[0] in asked]
    fixed: dict[str, ArrayLike] = {
        name: values[:, k] for k, name in enumerate(names) if name not in (*free, "position")
    }
    given = {p: x for p, x in hypothesis.fixed if p.rpartition(".")[0] in asked}
    loose = ("gain",) if evaluator.gain_sd else ()
    neutral = float(np.log(described("gain").neutral))
    return fit(
        partition.data,
        hypothesis.names,
        free=(*free, *loose),
        fixed={p: x for p, x in (fixed | given).items() if p not in loose},
        start={p: float(np.median(full.column(p))) for p in free},
        groups=groups_by_label(partition.data, tuple(free))
        | {p: np.arange(len(partition.data)) for p in loose},
        prior={p: (neutral, evaluator.gain_sd) for p in loose},
        noise=full.noise,
        simulator=partition.simulator,
    )


def _widest(found: Evaluator, had: Evaluator) -> Evaluator:
    """The recording on the bench whose simulator knows everything that either needs."""
    if len(found.training.simulator.names) >= len(had.training.simulator.names):
        return found
    return replace(
        found,
        training=Partition(found.training.data, had.training.simulator),
        held_out=Partition(found.held_out.data, had.held_out.simulator),
    )
