"""From a bench to a conclusion: names, a slot, or neither."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, has_own
from ventbench.diagnosis.latent_inputs import (
    GAIN,
    LATENT_INPUTS,
    MEASUREMENT,
    LatentInput,
    fit_latent_inputs,
    log_likelihood_without_input,
)
from ventbench.diagnosis.refinement import (
    PROMISING,
    Alternatives,
    NonparametricFit,
    SingleTermAlternative,
    UnnamedEffect,
    alternatives,
    backward_elimination,
    drop_compensating_terms,
    eliminate_beside_input,
    without_effort,
)
from ventbench.diagnosis.screening import (
    component_of,
    score_nonparametric_terms,
)
from ventbench.diagnosis.selection import (
    MUCH,
    Comparison,
    Progress,
    compare_candidates,
    fit_with_noise,
    forward_selection,
    passes_heldout_test,
)
from ventbench.diagnosis.settings import GATE
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise
from ventbench.system_id.together import each

#: A source at the sensor is noise unless it is of one frequency and this large, cmH2O.
_HUM = 0.3

#: Nats on held-out breaths from which a source is believed: places, scales and sizes are searched.
_SOURCE = 8.0

#: Share of what sources explain from which it is the gain that differs between breaths.
_SCATTERED = 1.0


@dataclass(frozen=True, eq=False)
class Conclusion:
    """What a recording needs.

    Attributes:
        null: the base model, refitted.
        named: with the names alone.
        full: with the slot's element too; ``named`` if there is none.
        place: the slot, or None.
        noise: that is left.
        nats: held-out log-likelihood that is lost without each name.
        alternatives: to each name.
        gain_sd: standard deviation of the logarithm of the breaths' valve gains, 0 if all are one.
        hidden: whether much is missing, and neither a name nor a place is believed.
    """

    null: FittedModel
    named: FittedModel
    full: FittedModel
    place: UnnamedEffect | None
    noise: Noise
    nats: dict[str, float]
    alternatives: dict[str, Alternatives]
    gain_sd: float = 0.0
    hidden: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Mechanisms of the library."""
        return self.named.hypothesis.names


def conclude(evaluator: Evaluator, wider: Callable[[], Evaluator], tell: Progress) -> Conclusion:
    """Name what is missing.

    Args:
        evaluator: with the library's parameters.
        wider: makes the same bench with those of all slots too.
        tell: is told what is done.
    """
    null = fit_with_noise(evaluator, Hypothesis())
    wider = cache(wider)
    named, steps = forward_selection(
        evaluator, null, tell, SingleTermAlternative(evaluator, wider, null)
    )
    tell("looking for what has no name")
    wide = wider()
    trimmed = drop_compensating_terms(evaluator, wide, named, tell)
    left = _left(evaluator, wide, trimmed)
    if trimmed is not named and not left.shaped:
        # What explains the names away must be there in their place.
        left = _left(evaluator, wide, named)
    else:
        named = trimmed
    if not evaluator.gain_sd and left.scatter:
        # Everything is asked anew, with a valve whose gain may differ between breaths.
        size = left.scatter
        return conclude(replace(evaluator, gain_sd=size), lambda: replace(wide, gain_sd=size), tell)
    source, shape = left.source, left.shape
    place, full = None, named
    if source is not None and not left.shaped:
        place, named = source, eliminate_beside_input(evaluator, named, source)
        full = named
    elif shape is not None:
        named, shape = backward_elimination(evaluator, wide, named, shape)
        place, full = (
            UnnamedEffect(component_of(shape.element), shape.element, None, shape.nats),
            shape.full,
        )
    tell("comparing alternatives")
    named, other = alternatives(evaluator, named, steps, swap=place is None)
    full = named if place is None else full
    noise = place.source.noise if place and place.source else full.noise
    hidden = place is None and not named.names and is_hidden(evaluator, steps)
    return Conclusion(
        null, named, full, place, noise, _losses(evaluator, named), other, evaluator.gain_sd, hidden
    )


def is_hidden(evaluator: Evaluator, steps: Sequence[Comparison]) -> bool:
    """Whether something explains much in training, and a little of held-out breaths, unbelieved.

    So do effects that hide each other, each of which alone helps some breaths and harms others.
    What is each breath's own does not count: it explains coloured noise as well.
    """
    if not steps:
        return False
    last = steps[-1]
    least = evaluator.criterion(last.before) - MUCH
    return any(
        one.criterion < least
        and float(
            (
                evaluator.held_out_log_likelihood(one.fitted)
                - evaluator.held_out_log_likelihood(last.before)
            ).sum()
        )
        > GATE
        for one in last.rivals
        if not has_own(one.name)
    )


@dataclass(frozen=True, eq=False)
class _Left:
    """What names leave unexplained.

    Attributes:
        shape: best element of a slot, or None.
        source: best source that moves in time, or None.
        scatter: standard deviation of the logarithm of the breaths' gains, 0 if all are one.
    """

    shape: NonparametricFit | None
    source: UnnamedEffect | None
    scatter: float

    @property
    def shaped(self) -> bool:
        """Whether a shape explains the most."""
        nats = 0.0 if self.source is None else self.source.nats
        return self.shape is not None and self.shape.nats >= nats


def _left(evaluator: Evaluator, wide: Evaluator, named: FittedModel) -> _Left:
    shape = _shape(wide, named)
    found = fit_latent_inputs(evaluator, without_effort(evaluator, named), (GAIN, *LATENT_INPUTS))
    reference = log_likelihood_without_input(evaluator, named)[1]
    gain = found.pop(GAIN)
    scatter = gain.size if _scattered(gain, found, reference, shape) else 0.0
    return _Left(shape, _source(found, reference), scatter)


def _shape(wide: Evaluator, named: FittedModel) -> NonparametricFit | None:
    """The element that explains most of what the names leave, if held-out breaths ask for it."""
    here = wide.fit(named.hypothesis, named.noise, named, iterations=3)
    found = compare_candidates(wide, here, score_nonparametric_terms(here)[:PROMISING])
    if found is None or not passes_heldout_test(found.gained):
        return None
    best = found.rivals[0]
    if wide.criterion(best.fitted) > wide.criterion(found.before):
        return None
    nats = float(
        (wide.held_out_log_likelihood(best.fitted) - wide.held_out_log_likelihood(here)).sum()
    )
    return NonparametricFit(best.name, best.fitted, nats)


def _scattered(
    gain: LatentInput,
    sources: dict[str, LatentInput],
    reference: Floats,
    shape: NonparametricFit | None,
) -> bool:
    """Whether the breaths' valve gains differ.

    That must explain more than any shape, and most of what sources do that move within breaths.
    """
    gained = gain.held_out - reference
    nats = float(gained.sum())
    others = [float((one.held_out - reference).sum()) for one in sources.values()]
    if not passes_heldout_test(gained) or (shape is not None and shape.nats > nats):
        return False
    return nats > _SCATTERED * max(others)


def _losses(evaluator: Evaluator, named: FittedModel) -> dict[str, float]:
    here = evaluator.held_out_log_likelihood(named)

    def lost(name: str) -> float:
        left = evaluator.fit(named.hypothesis.without(name), named.noise, named)
        return float((here - evaluator.held_out_log_likelihood(left)).sum())

    return dict(zip(named.names, each(lost, named.names), strict=True))


def _source(found: dict[str, LatentInput], reference: Floats) -> UnnamedEffect | None:
    """A source that moves in time and explains more than the names and than coloured noise."""
    others = dict(found)
    sensor = others.pop(MEASUREMENT)
    best = max(others.values(), key=lambda one: one.training)
    gained = best.held_out - reference
    ahead = float((best.held_out - sensor.held_out).sum())
    if passes_heldout_test(gained, _SOURCE) and ahead > GATE:
        return UnnamedEffect(best.source, None, best, float(gained.sum()))
    gained = sensor.held_out - reference
    if passes_heldout_test(gained) and sensor.periodic and sensor.size >= _HUM:
        return UnnamedEffect(MEASUREMENT, None, sensor, float(gained.sum()))
    return None
