"""Whether breaths that no fit has seen ask for a term.

One comparison: what could be added to a hypothesis, each fitted, at one noise.

Forward selection with a gate on held-out breaths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator, cross_validated_gain
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, has_own
from ventbench.diagnosis.latent_inputs import exceeds_sensor_noise
from ventbench.diagnosis.patient_effort import EFFORT
from ventbench.diagnosis.screening import Candidate, screen_mechanisms
from ventbench.diagnosis.settings import GATE
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise, estimate
from ventbench.system_id.together import each

#: How far the sum over breaths must exceed its own scatter.
_CONSISTENT = 1.3

#: Quantile of the gains' sizes that is usual, and times that beyond which they are cut off.
_USUAL, _FAR = 0.8, 1.5

#: Criterion from which the training breaths plainly ask for a term, and times the gate that it then
#: has to pass, as judgements of several splits hang together.
_PLAIN, _CROSSED = 20.0, 1.5

#: Share of a mild strength, and of all that is explained, below both of which a term is a trace.
WEAK, LITTLE = 0.2, 0.1


def passes_heldout_test(gained: Floats, gate: float = GATE) -> bool:
    """Whether held-out breaths ask for a term, by the log-likelihood that it gains in each.

    A split likelihood ratio: whatever the term, and however it was chosen, it exceeds the gate by
    chance in at most 1 % of the recordings. It must not hang on a few breaths either, nor may a few
    that fit nothing, as those of another rig, outvote the rest: with what is far from the others
    cut off, half of the gate must be left, and more than the sum's own scatter.
    """
    if float(gained.sum()) <= gate:
        return False
    far = _FAR * float(np.quantile(np.abs(gained), _USUAL))
    usual = np.clip(gained, -far, far)
    total, scatter = float(usual.sum()), float(np.sqrt(np.sum(usual**2)))
    return total > 0.5 * gate and total > _CONSISTENT * scatter


def is_needed(evaluator: Evaluator, current: FittedModel, without: FittedModel) -> bool:
    """Whether both the training breaths and the held-out ones ask for what the other one lacks.

    Where the training breaths plainly do and the held-out ones are too few to tell, every breath
    judges once, by fits to the others.

    Args:
        evaluator: of the recording.
        current: a hypothesis.
        without: with a term less, at the same noise.
    """
    gained = evaluator.criterion(without) - evaluator.criterion(current)
    if gained < 0:
        return False
    if passes_heldout_test(
        evaluator.held_out_log_likelihood(current) - evaluator.held_out_log_likelihood(without)
    ):
        return True
    return gained > _PLAIN and passes_heldout_test(
        cross_validated_gain(evaluator, current, without), _CROSSED * GATE
    )


def is_negligible(
    evaluator: Evaluator, current: FittedModel, without: FittedModel, name: str
) -> bool:
    """Whether a term is far weaker than a mild one and explains little beside the others.

    What another term's form or the integrator leaves, a tiny effect of almost any kind can trim,
    and enough breaths will believe it: a valve that is late by 1 ms beside four strong effects.

    Args:
        evaluator: of the recording.
        current: a hypothesis.
        without: with the term less, at the same noise.
        name: of the term.
    """
    item = mechanism(name).description.strength
    strength = float(np.max(np.abs(current.column(f"{name}.{item.name}") - item.neutral)))
    if has_own(name) or strength > WEAK * abs(item.mild - item.neutral):
        return False
    here = evaluator.criterion(current)
    nothing = evaluator.criterion(evaluator.fit(Hypothesis(), current.noise, current))
    return evaluator.criterion(without) - here < LITTLE * (nothing - here)


#: Nats from which a hypothesis explains much.
MUCH = 100.0

#: Candidates that are refitted, unless much is missing; nats below which one is not looked at.
_REFITTED, _FAINT = 6, 3.0

#: Steps of a first fit; nats of criterion, and share of the gain, within which one may still win.
_FEW, _NEAR, _SHARE = 12, 60.0, 0.1

#: Criterion that another noise must gain; most times that a fit and its noise take turns.
_LIKELIER, _SETTLED = 2.0, 5


@dataclass(frozen=True, eq=False)
class RankedModel:
    """A hypothesis that was compared with the one that was chosen, at the same noise."""

    name: str
    fitted: FittedModel
    criterion: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """One comparison: what could be added to a hypothesis.

    Attributes:
        before: without, at the same noise.
        rivals: the candidates, best first.
        gained: held-out log-likelihood of the best, less that without, by breath.
    """

    before: FittedModel
    rivals: tuple[RankedModel, ...]
    gained: Floats

    @property
    def nats(self) -> float:
        """Held-out log-likelihood that the best gains."""
        return float(self.gained.sum())


def estimate_noise(fitted: FittedModel) -> Noise:
    """Noise that a hypothesis leaves on the training breaths."""
    return estimate(fitted.residual, fitted.problem.data.weight)


def fit_with_noise(
    evaluator: Evaluator, hypothesis: Hypothesis, near: FittedModel | None = None
) -> FittedModel:
    """Fit a hypothesis and its noise in turn."""
    fitted = evaluator.fit(hypothesis, near.problem.noise if near else Noise(), near)
    for _ in range(_SETTLED):
        noise = estimate_noise(fitted)
        again = evaluator.fit(hypothesis, noise, fitted, restart=True)
        gained = again.log_likelihood - fitted.log_likelihood_at(noise)
        fitted = again if gained > 0 else evaluator.fit(hypothesis, noise, fitted)
        if gained < _LIKELIER:
            break
    return fitted


def fit_with_white_noise(evaluator: Evaluator, current: FittedModel) -> FittedModel:
    """The same hypothesis at white noise.

    Coloured noise excuses an error that is slow, and R, C and PEEP may go anywhere for it.
    """
    white = replace(current.noise, ar=(0.0, 0.0))
    near = current if current.names else None
    return evaluator.fit(current.hypothesis, white, near)


def compare_candidates(
    evaluator: Evaluator,
    current: FittedModel,
    candidates: list[Candidate],
    near: FittedModel | None = None,
) -> Comparison | None:
    """Compare what could be added; None if nothing is worth a look.

    Args:
        evaluator: of the recording.
        current: the hypothesis that is added to.
        candidates: what could be.
        near: where fits start; ``current`` if not given.
    """
    found = [one for one in candidates if max(one.nats, one.white) > _FAINT]
    if not found:
        return None
    # Templates are linear: where much is missing they rank badly, and all are refitted.
    if max(one.nats for one in found) < MUCH:
        found = found[:_REFITTED]
    # Whitened by what an effect leaves in the residual, its own fit would hardly see it.
    white = replace(current.noise, ar=(0.0, 0.0))
    rivals = each(
        lambda one: evaluator.fit(
            current.hypothesis.plus(one.hypothesis), white, near or current, one.start,
            iterations=_FEW, tolerance=0.1,
        ),
        found,
    )  # fmt: skip
    criterion = _Criteria(evaluator)
    own = each(lambda one: criterion(one, estimate_noise(one)), rivals)
    noise = criterion.likelier(rivals[int(np.argmin(own))], current.noise)
    order = criterion.order(rivals, noise)
    for _ in range(3):
        # At the noise of the best, all that may still win is fitted further.
        order[0] = evaluator.fit(order[0].hypothesis, noise, order[0])
        noise = criterion.likelier(order[0], noise)
        order = criterion.order(order, noise)
        best = criterion(order[0], noise)
        limit = best + max(_NEAR, _SHARE * (criterion(current, noise) - best))
        order = criterion.order(_further(evaluator, order, noise, criterion, limit), noise)
        if criterion.likelier(order[0], noise) is noise:
            break
    if noise is not current.noise:
        current = evaluator.fit(current.hypothesis, noise, current)
    listed = tuple(RankedModel(x.hypothesis.names[-1], x, criterion(x, noise)) for x in order)
    return Comparison(
        current,
        listed,
        evaluator.held_out_log_likelihood(order[0]) - evaluator.held_out_log_likelihood(current),
    )


def _further(
    evaluator: Evaluator, order: list[FittedModel], noise: Noise, criterion: _Criteria, limit: float
) -> list[FittedModel]:
    """The same, those below a limit fitted on at a noise."""

    def further(one: FittedModel) -> FittedModel:
        return evaluator.fit(one.hypothesis, noise, one) if criterion(one, noise) < limit else one

    return each(further, order)


class _Criteria:
    """Criteria of fits at several noises, each computed once."""

    def __init__(self, evaluator: Evaluator) -> None:
        self._bench = evaluator
        self._known: dict[tuple[int, Noise], tuple[FittedModel, float]] = {}

    def __call__(self, fitted: FittedModel, noise: Noise) -> float:
        key = (id(fitted), noise)
        if key not in self._known:  # which keeps the fit, and thereby its identity
            self._known[key] = (fitted, self._bench.criterion(fitted, noise))
        return self._known[key][1]

    def likelier(self, fitted: FittedModel, noise: Noise) -> Noise:
        """The noise that a fit leaves, if it makes the fit clearly likelier than another one."""
        own = estimate_noise(fitted)
        return own if self(fitted, own) < self(fitted, noise) - _LIKELIER else noise

    def order(self, rivals: list[FittedModel], noise: Noise) -> list[FittedModel]:
        """The best first."""
        return sorted(rivals, key=lambda one: self(one, noise))


#: Most terms, and comparisons: a term that was dropped may come back, but not for ever.
_MOST, _ROUNDS = 6, 14

#: Names from which it is asked whether something else does better; of fewer, the next may be what
#: is missing.
_SEVERAL = 4

#: Share of what efforts explain from which an effect that all breaths share goes first.
_MOSTLY = 0.5

#: Candidates that are tried where the best one is not believed.
_OTHERS = 3

#: Nats from which a shape is freed.
_SHAPE = 2.0

Progress = Callable[[str], None]
Simpler = Callable[[FittedModel], FittedModel | None]


def forward_selection(
    evaluator: Evaluator, start: FittedModel, tell: Progress, simpler: Simpler = lambda _: None
) -> tuple[FittedModel, list[Comparison]]:
    """Add terms while held-out breaths ask for them, and drop those that a later one replaces.

    Args:
        evaluator: of the recording.
        start: what terms are added to.
        tell: is told what is done.
        simpler: gives what ends the search if something else does better than all terms.
    """
    current, steps = start, []
    for _ in range(_ROUNDS):
        if len(current.hypothesis.names) == _MOST:
            break
        tell(f"comparing mechanisms ({len(current.hypothesis.names)} named)")
        white = fit_with_white_noise(evaluator, current)
        found = compare_candidates(
            evaluator,
            current,
            screen_mechanisms(current, white, evaluator.allowed_mechanisms),
            white,
        )
        if found is None:
            break
        steps.append(found)
        best = _best(evaluator, found)
        if best is None:
            break
        current = drop_redundant_terms(evaluator, free_shape_parameters(evaluator, best))
        if len(current.names) < _SEVERAL:
            continue
        instead = simpler(current)
        if instead is not None:
            return instead, []
    instead = simpler(current)
    return (current, steps) if instead is None else (instead, [])


def _best(evaluator: Evaluator, found: Comparison) -> FittedModel | None:
    """The candidate to go on with, or None if none is believed.

    What is free in each breath looks like any sum of effects, so that efforts wait for what is the
    same in all breaths.
    """
    first = found.rivals[0]
    if has_own(first.name):
        nothing = evaluator.criterion(found.before)
        enough = nothing - _MOSTLY * (nothing - first.criterion)
        shared = (x for x in found.rivals if x.criterion < enough and not has_own(x.name))
        with_it = _beyond(evaluator, found, next(shared, None))
        if with_it is not None:
            return with_it
    if not passes_heldout_test(found.gained) and not is_needed(
        evaluator, first.fitted, found.before
    ):
        return _other(evaluator, found)
    best = _settled(evaluator, first)
    if is_negligible(evaluator, best, _without(evaluator, found, best), first.name):
        return _other(evaluator, found)
    if first.name != EFFORT or exceeds_sensor_noise(evaluator, best):
        return best
    return _beyond(evaluator, found, next((x for x in found.rivals if not has_own(x.name)), None))


def _beyond(
    evaluator: Evaluator, found: Comparison, rival: RankedModel | None
) -> FittedModel | None:
    """With a rival, settled, if it is needed there."""
    if rival is None:
        return None
    with_it = _settled(evaluator, rival)
    without = _without(evaluator, found, with_it)
    if not is_needed(evaluator, with_it, without) or is_negligible(
        evaluator, with_it, without, rival.name
    ):
        return None
    return with_it


def _without(evaluator: Evaluator, found: Comparison, with_it: FittedModel) -> FittedModel:
    """What a step added to, at the noise of what it gives."""
    return evaluator.fit(found.before.hypothesis, with_it.noise, found.before)


def _settled(evaluator: Evaluator, rival: RankedModel) -> FittedModel:
    """Fitted at its own noise: that of a step still holds much of the effect."""
    return fit_with_noise(evaluator, rival.fitted.hypothesis, rival.fitted)


def _other(evaluator: Evaluator, found: Comparison) -> FittedModel | None:
    """Another candidate that explains much and is believed, where the best one is not.

    So does a sum of several effects look to what is free in each breath: large, and never twice
    alike.
    """
    least = evaluator.criterion(found.before) - MUCH
    own = [(evaluator.criterion(x.fitted, estimate_noise(x.fitted)), x) for x in found.rivals[1:]]
    promising = sorted((pair for pair in own if pair[0] < least), key=lambda pair: pair[0])
    for _, rival in promising[:_OTHERS]:
        with_it = _beyond(evaluator, found, rival)
        if with_it is not None:
            return with_it
    return None


def free_shape_parameters(evaluator: Evaluator, current: FittedModel) -> FittedModel:
    """Free what shapes the newest term's effect, if the recording asks for it."""
    name = current.hypothesis.names[-1]
    for item in mechanism(name).description.parameters:
        path = f"{name}.{item.name}"
        if not item.shape or item.discrete:
            continue
        freer = evaluator.fit(
            current.hypothesis.plus(Hypothesis((name,), (path,))), current.noise, current
        )
        if evaluator.criterion(freer) > evaluator.criterion(current):
            continue
        if (
            float(
                (
                    evaluator.held_out_log_likelihood(freer)
                    - evaluator.held_out_log_likelihood(current)
                ).sum()
            )
            > _SHAPE
        ):
            current = freer
    return current


def drop_redundant_terms(evaluator: Evaluator, current: FittedModel) -> FittedModel:
    """Leave out terms that are not needed any more."""
    for name in current.hypothesis.names[:-1]:
        without = evaluator.fit(current.hypothesis.without(name), current.noise, current)
        if not is_needed(evaluator, current, without) or is_negligible(
            evaluator, current, without, name
        ):
            current = without
    return current
