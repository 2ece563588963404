"""A recording against a simulator that has physics of its own, whatever it is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ventbench.diagnosis import estimates, simulators
from ventbench.diagnosis.found import Found, found_in
from ventbench.diagnosis.hypothesis import FittedModel, Partition
from ventbench.system_id import Fit
from ventbench.system_id.data import Data, Floats

#: Share of the error of everything that is found in the recording alone below which the recording
#: beside the simulator says more.
_CLEARER = 0.9


def against(
    data: Data, held: NDArray[np.bool_], before: Floats, alone: Found,
    excluded: tuple[str, ...], tell: Callable[[str], None],
) -> tuple[Found, Found]:  # fmt: skip
    """Ask a simulator the questions that its recording was asked.

    What neither the language nor its names can say of a simulator may be true of the recording as
    well: valves that differ from breath to breath, shapes that were learned. Where the simulator
    errs less by it than the language does, it is taken out of the recording, and the recording is
    asked anew: what is then found is what the simulator lacks, and nothing else.

    Args:
        data: of n recorded breaths.
        held: which of them are held out, ``(n,)``.
        before: the simulator's answers, cmH2O, ``(n, T)``.
        alone: what was found in the recording.
        excluded: mechanisms that cannot act.
        tell: is told what is done.

    Returns:
        What was found in the recording, and in the simulator.
    """
    answered = simulators.measured(data, before, alone.conclusion.noise)
    settings = alone.evaluator.settings
    had = found_in(answered, held, excluded, lambda what: tell(f"simulator: {what}"), settings)
    first = before[:, 0]
    own = had.pressures(had.conclusion.full, held, first)
    beyond = np.nan_to_num(before - own)
    beside = data.answered(data.seen[:, 0] - beyond)
    least = had.pressures(refitted(had, beside.select(~held)), held, first) + beyond
    # As of breaths to come: what each breath has of its own is not known of them.
    most = alone.pressures(alone.conclusion.full, held, first)
    seen = data.select(~held)
    errs = min(_error(seen, before[~held]), _error(seen, least[~held]))
    if errs >= _CLEARER * _error(seen, most[~held]):
        return alone, had
    found = found_in(
        beside, held, excluded, lambda what: tell(f"beside the simulator: {what}"), settings
    )
    return found, replace(had, fit=_exactly(had, data.answered(own), held, found))


def _exactly(had: Found, own: Data, held: NDArray[np.bool_], like: Found) -> Fit:
    """Fit of the simulator's own physics to its answers without what the language cannot say.

    Its parameters are what it was taken to have; their reach is what such breaths tell of them.
    """
    fitted = had.conclusion.full
    partition = Partition(own.select(~held), had.evaluator.training.simulator)
    problem = replace(fitted.problem, noise=like.conclusion.noise)
    return estimates.estimated(replace(fitted, problem=problem), partition, had.evaluator)


def refitted(had: Found, data: Data, like: Found | None = None) -> FittedModel:
    """The simulator's own physics with R, C, R_ex, PEEP of other breaths.

    Args:
        had: what was found in the simulator.
        data: the breaths.
        like: whose noise is taken; the simulator's if not given.
    """
    own = had.conclusion.full
    evaluator = had.evaluator
    noise = (like or had).conclusion.noise
    partition = Partition(data, evaluator.training.simulator)
    return evaluator.fit(own.hypothesis, noise, own, partition=partition)


def _error(data: Data, pressure: Floats) -> float:
    """Mean absolute error where pressure was measured, cmH2O."""
    weight = data.weight[:, 0]
    return float(np.sum(np.abs(pressure - data.seen[:, 0]) * weight) / np.sum(weight))
