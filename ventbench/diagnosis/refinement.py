"""Which names are needed beside something that has none.

Names that only trim the form of another one.

Where the recording's leak is linear and the library's is a root, a second mechanism may bend one
into the other, and held-out breaths believe it. An element of a slot of the first name's own kind
then does as well or better, and with it the second name is not needed any more. A mechanism that
acts passes the test: no element of another's kind explains it away.

One shape instead of many names.

What the library has no name for can be imitated by a sum of names, each of which the breaths
believe. If one element of a slot does better alone, the sum is an imitation.

Which other names the recording cannot tell from the ones that were chosen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from operator import itemgetter

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.latent_inputs import (
    ALVEOLUS,
    LatentInput,
    fit_latent_inputs,
    log_likelihood_without_input,
)
from ventbench.diagnosis.patient_effort import EFFORT
from ventbench.diagnosis.screening import (
    score_nonparametric_terms,
    screen_mechanisms,
)
from ventbench.diagnosis.selection import (
    Comparison,
    Progress,
    RankedModel,
    compare_candidates,
    fit_with_noise,
    fit_with_white_noise,
    is_needed,
    passes_heldout_test,
)
from ventbench.diagnosis.settings import GATE
from ventbench.physics.catalogue import mechanism, special_cases
from ventbench.system_id.data import Floats
from ventbench.system_id.together import each

#: Share of what a slot of the same kind explains from which a name stands, its form apart; and
#: share below which a name beside a slot is only its trimming.
_FAMILY, _COMPENSATING_SHARE = 0.5, 0.1

#: Elements of slots that are refitted: the first-order ranking has the right one near its top.
PROMISING = 5


@dataclass(frozen=True, eq=False)
class UnnamedEffect:
    """Where something without a name sits.

    Attributes:
        name: public name of the slot.
        element: of the physics that has its shape, or None for a source that moves in time.
        source: that source, or None.
        nats: held-out log-likelihood that it gains.
    """

    name: str
    element: str | None
    source: LatentInput | None
    nats: float


@dataclass(frozen=True, eq=False)
class NonparametricFit:
    """An element of a slot beside names.

    Attributes:
        element: its name.
        full: fitted with the names.
        nats: held-out log-likelihood that it gains.
    """

    element: str
    full: FittedModel
    nats: float


def without_effort(evaluator: Evaluator, named: FittedModel) -> FittedModel:
    """The same names without efforts of the patient, which sources take the place of."""
    if EFFORT not in named.hypothesis.names:
        return named
    return evaluator.fit(named.hypothesis.without(EFFORT), named.noise, named)


def eliminate_beside_input(
    evaluator: Evaluator, named: FittedModel, place: UnnamedEffect
) -> FittedModel:
    """Keep the names that are needed beside a source, and those that explain more than it does.

    A source is each breath's own and takes over what is the same in all breaths as well.
    """
    assert place.source is not None
    current, here = without_effort(evaluator, named), place.source
    gains = each(partial(_gain, evaluator, current), current.names)
    firm = {name for name, gain in zip(current.names, gains, strict=True) if gain > place.nats}
    if _is_effort(evaluator, named, current, here):
        current = named
    while True:
        asked = [name for name in current.names if name != EFFORT and name not in firm]
        idle = [x for x in each(partial(_idle, evaluator, current, here), asked) if x is not None]
        if not idle:
            return current
        # The least needed one first: others may be needed once it has gone.
        _, current, here = min(idle, key=lambda found: found[0])


def _gain(evaluator: Evaluator, named: FittedModel, name: str) -> float:
    """Held-out log-likelihood that a name gains beside the others."""
    left = evaluator.fit(named.hypothesis.without(name), named.noise, named)
    return float(
        (evaluator.held_out_log_likelihood(named) - evaluator.held_out_log_likelihood(left)).sum()
    )


def _idle(
    evaluator: Evaluator, current: FittedModel, here: LatentInput, name: str
) -> tuple[float, FittedModel, LatentInput] | None:
    """Nats that are lost without a name beside a source, and what is left, if it is not needed."""
    left = evaluator.fit(current.hypothesis.without(name), current.noise, current)
    other = fit_latent_inputs(evaluator, without_effort(evaluator, left), (here.source,))[
        here.source
    ]
    lost = here.held_out - other.held_out
    return None if passes_heldout_test(lost) else (float(lost.sum()), left, other)


def _is_effort(
    evaluator: Evaluator, named: FittedModel, without: FittedModel, source: LatentInput
) -> bool:
    """Whether a source is an effort of another form: efforts explain most of what it does."""
    if EFFORT not in named.hypothesis.names or source.periodic or source.source != ALVEOLUS:
        return False
    none = log_likelihood_without_input(evaluator, without)[1].sum()
    by_name = log_likelihood_without_input(evaluator, named)[1].sum() - none
    return bool(by_name >= _FAMILY * (source.held_out.sum() - none))


def backward_elimination(
    evaluator: Evaluator, wide: Evaluator, named: FittedModel, shape: NonparametricFit
) -> tuple[FittedModel, NonparametricFit]:
    """Keep the names that are needed beside a shape, and those whose form it only trims."""
    element, full, nats = shape.element, shape.full, shape.nats
    kept = named.hypothesis
    for name in named.hypothesis.names:
        left = wide.fit(full.hypothesis.without(name), full.noise, full)
        whole = full.log_likelihood - _null(wide, full)
        if name in special_cases(element):
            least = evaluator.fit(kept.without(name), named.noise, named)
            by_name = named.log_likelihood_at(full.noise) - least.log_likelihood_at(full.noise)
            by_both = full.log_likelihood - least.log_likelihood_at(full.noise)
            if by_name >= _FAMILY * by_both:
                continue
        share = (full.log_likelihood - left.log_likelihood) / max(whole, 1e-9)
        if not is_needed(wide, full, left) or share < _COMPENSATING_SHARE:
            full, kept = fit_with_noise(wide, left.hypothesis, left), kept.without(name)
    if kept != named.hypothesis:
        named = fit_with_noise(evaluator, kept, named)
    if not kept.names:
        # Chosen anew, without names that took part of the effect.
        null = wide.fit(Hypothesis(), named.noise, named)
        again = compare_candidates(wide, null, score_nonparametric_terms(null)[:PROMISING])
        if again is not None and passes_heldout_test(again.gained):
            element, full = again.rivals[0].name, again.rivals[0].fitted
            nats = float(again.gained.sum())
    return named, NonparametricFit(element, full, nats)


def _null(wide: Evaluator, full: FittedModel) -> float:
    """Log-likelihood of the base model at the noise of a hypothesis."""
    return wide.fit(Hypothesis(), full.noise, full).log_likelihood


#: Share of all that is explained up to which a name may be a trimming.
_MOST_COMPENSATED = 0.5

#: Share of a name's gain, and nats, that an element may fall short by; and share of the gain that
#: the name may still have beside it.
_SHORT, _NATS, _LEFT = 0.05, 3.0 * GATE, 0.1

#: Share of a name's gain that an element must promise to first order to be fitted.
_PROMISE = 0.4


def drop_compensating_terms(
    evaluator: Evaluator, wide: Evaluator, named: FittedModel, tell: Progress
) -> FittedModel:
    """Drop the names that an element of another name's own kind explains away.

    Args:
        evaluator: with the library's parameters.
        wide: with those of all slots too.
        named: the names, fitted.
        tell: is told what is done.
    """
    while len(named.hypothesis.names) > 1:
        tell("looking for names that trim others")
        trimming = _first(wide, named)
        if trimming is None:
            break
        named = fit_with_noise(evaluator, named.hypothesis.without(trimming), named)
    return named


def _first(wide: Evaluator, named: FittedModel) -> str | None:
    """The least of the names that trim another one."""
    null = wide.fit(Hypothesis(), named.noise)
    here = wide.training_log_likelihood(named)
    whole = max(here - null.log_likelihood, 1e-9)
    base = wide.held_out_log_likelihood(named)
    lefts = each(
        lambda name: wide.fit(named.hypothesis.without(name), named.noise, named),
        named.hypothesis.names,
    )
    lost = [here - wide.training_log_likelihood(left) for left in lefts]
    for name, left, nats in sorted(zip(named.names, lefts, lost, strict=True), key=itemgetter(2)):
        if nats < _MOST_COMPENSATED * whole and _explained_away(
            wide, named, left, name, nats, base
        ):
            return name
    return None


def _explained_away(
    wide: Evaluator, named: FittedModel, left: FittedModel, name: str, nats: float, base: Floats
) -> bool:
    gained = float((base - wide.held_out_log_likelihood(left)).sum())
    for candidate in score_nonparametric_terms(left):
        element = candidate.name
        kin = special_cases(element)
        if not set(kin) & set(left.hypothesis.names):
            continue
        if max(candidate.nats, candidate.white) < _PROMISE * nats:
            continue
        instead = wide.fit(left.hypothesis.plus(Hypothesis((element,))), left.noise, left)
        ahead = wide.held_out_log_likelihood(instead) - base
        # An element that holds both can always stand for one: only if both have another form.
        short = -min(_SHORT * gained, _NATS)
        if not passes_heldout_test(ahead) if name in kin else ahead.sum() < short:
            continue
        both = wide.fit(named.hypothesis.plus(Hypothesis((element,))), named.noise, instead)
        if (
            float(
                (wide.held_out_log_likelihood(both) - wide.held_out_log_likelihood(instead)).sum()
            )
            < _LEFT * gained
        ):
            return True
    return False


#: Names from which a sum may be an imitation.
_MANY = 3


class SingleTermAlternative:
    """The best shape alone, found when it is first asked for."""

    def __init__(
        self, evaluator: Evaluator, wider: Callable[[], Evaluator], null: FittedModel
    ) -> None:
        """Remember what to look at.

        Args:
            evaluator: with the library's parameters.
            wider: gives the same bench with those of all slots too.
            null: nothing but R, C, R_ex and PEEP, settled.
        """
        self._bench, self._wider, self._null = evaluator, wider, null

    def __call__(self, named: FittedModel) -> FittedModel | None:
        """What is left of many names if one shape does better alone; else None."""
        if len(named.names) < _MANY or self._best is None:
            return None
        wide, shape = self._wider(), self._best.fitted
        if wide.criterion(shape) > self._bench.criterion(named):
            return None
        if (
            wide.held_out_log_likelihood(shape).sum()
            < self._bench.held_out_log_likelihood(named).sum()
        ):
            return None
        kin = special_cases(self._best.name)
        kept = tuple(name for name in named.names if name in kin)
        if not kept:
            return self._null
        return fit_with_noise(
            self._bench, named.hypothesis.without(*set(named.names) - set(kept)), named
        )

    @cached_property
    def _best(self) -> RankedModel | None:
        wide = self._wider()
        here = wide.fit(Hypothesis(), self._null.noise, self._null, iterations=3)
        found = compare_candidates(wide, here, score_nonparametric_terms(here)[:PROMISING])
        if found is None:
            return None
        best = found.rivals[0]
        return RankedModel(
            best.name, fit_with_noise(wide, best.fitted.hypothesis, best.fitted), best.criterion
        )


#: Criterion (twice the nats) within which a name is an alternative, and most that are listed.
_CLOSE, _LISTED = 10.0, 2


@dataclass(frozen=True, eq=False)
class Alternatives:
    """To one name.

    Attributes:
        names: the likeliest first.
        confidence: share of the posterior of equal priors that falls on the name itself.
        rivals: fitted, of mechanisms of the library.
    """

    names: tuple[str, ...]
    confidence: float
    rivals: tuple[RankedModel, ...]


def alternatives(
    evaluator: Evaluator, named: FittedModel, steps: list[Comparison], *, swap: bool = True
) -> tuple[FittedModel, dict[str, Alternatives]]:
    """Replace each name by every other one, and keep what is better.

    Returns:
        The best set of names, and for each the alternatives.
    """
    for last in (False, False, True):
        criterion, names = evaluator.criterion(named), named.names
        rivals = each(partial(_rivals, evaluator, named, steps), names)
        better = [one[0].fitted for one in rivals if one and one[0].criterion < criterion]
        if last or not swap or not better:
            break
        named, steps = better[0], []
    return named, {
        name: _close(name, others, criterion) for name, others in zip(names, rivals, strict=True)
    }


def _rivals(
    evaluator: Evaluator, named: FittedModel, steps: list[Comparison], name: str
) -> list[RankedModel]:
    rest = named.hypothesis.without(name)
    known = [s for s in steps if s.before.hypothesis == rest and s.rivals[0].name == name]
    if known:
        # Those that stayed far behind were not fitted to the end.
        return _again(evaluator, known[-1].rivals[1:4], named)
    base = evaluator.fit(rest, named.noise, named)
    white = fit_with_white_noise(evaluator, base)
    candidates = [
        one
        for one in screen_mechanisms(base, white, evaluator.allowed_mechanisms)
        if one.name != name
    ]
    found = compare_candidates(evaluator, base, candidates, white)
    if found is None or not passes_heldout_test(found.gained):
        return []
    return _again(evaluator, found.rivals[:3], named)


def _again(
    evaluator: Evaluator, rivals: tuple[RankedModel, ...], named: FittedModel
) -> list[RankedModel]:
    """The same at the noise of the names, the best first."""
    again = [
        RankedModel(one.name, one.fitted, evaluator.criterion(one.fitted, named.noise))
        for one in rivals
    ]
    return sorted(again, key=lambda one: one.criterion)


def _close(name: str, rivals: list[RankedModel], criterion: float) -> Alternatives:
    near = [one for one in rivals if one.criterion < criterion + _CLOSE][:_LISTED]
    odds = np.exp(-0.5 * np.array([max(one.criterion - criterion, 0.0) for one in near]))
    names = tuple(one.name for one in near) + mechanism(name).description.equivalents
    return Alternatives(names[:_LISTED], float(1.0 / (1.0 + odds.sum())), tuple(near))
