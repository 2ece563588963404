"""The model that a recording needs: mechanisms, an unnamed effect beside them, or neither.

:func:`conclude` searches by evidence (:mod:`ventbench.diagnosis.evidence`). The likeliest set
is fitted to the training breaths, and held-out breaths accept each of its terms: what they do not
ask for is dropped, the least needed first. Alternatives are the other sets of the posterior.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.diagnosis import evidence
from ventbench.diagnosis.evaluator import Evaluator, fit_with_noise
from ventbench.diagnosis.evidence import IN_TIME, WARMTH, Posterior, Scored
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, Partition
from ventbench.diagnosis.in_time import SWINGS, swing_columns, swing_spreads
from ventbench.diagnosis.linearised import EFFORT, Term, names_of
from ventbench.diagnosis.unknown import preference, unplaced_gain
from ventbench.diagnosis.validation import (
    is_needed,
    is_plausible,
    passes_heldout_test,
)
from ventbench.physics.catalogue import basis_terms, library, mechanism
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.system_id.data import Noise

#: Receives the current step, in words.
Progress: TypeAlias = Callable[[str], None]

#: Least posterior odds of a name that is listed as an alternative, and most that are.
_MIN_ODDS, _LISTED = 0.05, 2


@dataclass(frozen=True, eq=False)
class Alternatives:
    """Alternative explanations of the effect of a selected mechanism."""

    names: tuple[str, ...]  #: other mechanisms, the likeliest first.
    confidence: float  #: posterior probability of the selected mechanism, over all sets.
    models: tuple[FittedModel, ...]  #: models with an alternative in its place.


@dataclass(frozen=True, eq=False)
class Swing:
    """A periodic input with a size and phase of its own in each breath."""

    frequency: float  #: Hz.
    frequency_sd: float  #: standard deviation, Hz.
    course: Floats  #: expected course in each training breath, cmH2O or a share, ``(n, T)``.
    noise: Noise  #: noise beside it.
    held_out_log_likelihood: Floats  #: of each held-out breath with it, nats, ``(h,)``.
    #: root-mean-square error that it takes from held-out breaths, cmH2O.
    worth: float


@dataclass(frozen=True, eq=False)
class UnnamedEffect:
    """An effect for which the library has no mechanism."""

    name: str  #: public name of the nonparametric component, or of the input's place.
    term: str | None  #: the component's basis term, or None for a periodic input.
    swing: Swing | None  #: the input, or None for a basis term.
    nats: float  #: held-out log-likelihood that it gains.
    #: posterior weight of each place, the largest first.
    places: tuple[tuple[str, float], ...] = ()
    #: root-mean-square error that it takes from held-out breaths, cmH2O; NaN if unknown.
    worth: float = float("nan")
    probability: float = 1.0  #: posterior probability that it acts.


@dataclass(frozen=True, eq=False)
class Conclusion:
    """The models that a recording needs."""

    base: FittedModel  #: the base model with its noise.
    named: FittedModel  #: the selected mechanisms.
    full: FittedModel  #: the mechanisms and the nonparametric term; ``named`` if there is none.
    unnamed: UnnamedEffect | None  #: the unnamed effect, or None.
    noise: Noise  #: model of the noise that is left.
    #: held-out log-likelihood that each mechanism gains, nats, by name.
    held_out_gains: dict[str, float]
    alternatives: dict[str, Alternatives]  #: alternatives to each mechanism, by name.
    #: standard deviation of the logarithm of the breaths' valve gains; 0 if all breaths have the
    #: same gain.
    gain_sd: float = 0.0
    white: bool = False  #: whether the noise of the fits is white.
    #: whether much is missing, and neither mechanism nor unnamed effect is accepted.
    unresolved: bool = False
    #: root-mean-square error, cmH2O, by which held-out breaths are fitted worse without each
    #: mechanism, by name.
    worths: dict[str, float] = field(default_factory=dict)
    #: over the sets of terms.
    posterior: Posterior = field(default_factory=lambda: Posterior((), {}))

    @property
    def names(self) -> tuple[str, ...]:
        """The selected mechanisms."""
        return self.named.names


def component_of(term: str) -> str:
    """Public name of the nonparametric component that a basis term belongs to."""
    components = NONPARAMETRIC_COMPONENTS.values()
    return next(component.name for component in components if term in component.terms)


def conclude(
    evaluator: Evaluator, every: Partition, tell: Progress, also: Sequence[str] = ()
) -> Conclusion:
    """Find what a recording needs beyond the base model.

    Args:
        evaluator: evaluator with the parameters of all candidates.
        every: the breaths that are searched: its training breaths, and perhaps others that judge no
            corrected simulator.
        tell: called with a description of each step before it runs.
        also: names of mechanisms that are tried in any case.
    """
    tell("searching")
    posterior = evidence.search(replace(evaluator, training=every), also)
    tell("comparing with held-out breaths")
    base = fit_with_noise(evaluator, Hypothesis())
    judged = _judge(evaluator, posterior)
    settings = evaluator.settings.search
    readings = evaluator.training.data.weight
    slow = judged.accepted.noise.autocorrelation_time(readings) > 1.0 / WARMTH
    # Effects of some breaths are set aside before.
    if slow and settings.ventilator and not posterior.likely_events:
        tell("searching from all of a ventilator")
        white = replace(evaluator, white=True, excluded=(*evaluator.excluded, *IN_TIME))
        of_ventilator = evidence.search(replace(white, training=every), settings.ventilator)
        rival = _judge(white, of_ventilator)
        errors = [each.evaluator.mean_square(each.accepted) for each in (rival, judged)]
        if errors[0] < settings.error_ratio**2 * errors[1]:
            posterior, judged = of_ventilator, rival
    best, evaluator, candidate, full, gains, worths = judged
    names = names_of(best.terms)
    unknown = [name for name in full.names if name in basis_terms()]
    if len(unknown) > 1:  # one of them is reported
        unknown.sort(key=gains.__getitem__)
        full = fit_with_noise(evaluator, full.hypothesis.minus(*unknown[:-1]), full)
    named, unnamed = full, None
    if unknown:
        term = unknown[-1]
        named = fit_with_noise(evaluator, full.hypothesis.minus(term), full)
        unnamed = UnnamedEffect(
            component_of(term),
            term,
            None,
            gains[term],
            _places(posterior, names, component_of(term), term),
            worths[term],
            posterior.marginal(term),
        )
    noise = full.noise
    for term in best.terms:
        if unnamed is None and term.name in SWINGS:
            swing, gained = _swing(evaluator, full, term)
            least = evaluator.settings.search.course_nats
            rival = unplaced_gain(evaluator, full, evaluator.held_out)
            if swing.worth >= evaluator.settings.residuals.negligible and passes_heldout_test(
                gained, evaluator.settings.held_out_test, max(least, rival + least)
            ):
                place = SWINGS[term.name][0]
                unnamed = UnnamedEffect(
                    place,
                    None,
                    swing,
                    float(gained.sum()),
                    _places(posterior, names, place, term.name),
                    swing.worth,
                    posterior.marginal(term.name) * preference(float(gained.sum()) - rival),
                )
                noise = swing.noise
    return Conclusion(
        base,
        named,
        full,
        unnamed,
        noise,
        {name: gains[name] for name in named.names},
        {name: _alternatives(evaluator, posterior, names, named, name) for name in named.names},
        evaluator.gain_sd,
        evaluator.white,
        unnamed is None and not named.names and _is_unresolved(evaluator, candidate),
        {name: worths[name] for name in named.names},
        posterior,
    )


class _Judgement(NamedTuple):
    """A set after held-out breaths had their say."""

    chosen: Scored  #: the set.
    evaluator: Evaluator  #: with the scatter of the gains.
    candidate: FittedModel  #: all of its terms that are parameters of a fit.
    accepted: FittedModel  #: those that are accepted.
    gains: dict[str, float]  #: of each of these, held-out log-likelihood, nats.
    worths: dict[str, float]  #: of each of these, root-mean-square error, cmH2O.


def _judge(evaluator: Evaluator, posterior: Posterior) -> _Judgement:
    """Let held-out breaths judge the likeliest set, and what is likelier than the rest of it.

    Of these, the one is taken whose open-loop error on held-out breaths is least: coloured noise
    makes up for much of what a likelihood sees.
    """
    chosen = posterior.undecided(evaluator.settings.held_out_test.threshold)
    rejected: set[str] = set()
    judgements: list[tuple[float, _Judgement]] = []
    while True:
        candidate, now = _fitted(evaluator, chosen), evaluator
        gain_sd = _gain_sd(evaluator, candidate, posterior.fitted[0].scatter)
        if gain_sd:
            now = replace(evaluator, gain_sd=gain_sd)
            candidate = fit_with_noise(now, candidate.hypothesis, candidate)
        judged = _Judgement(chosen, now, candidate, *eliminate(now, candidate))
        judgements.append((now.mean_square(judged.accepted), judged))
        dropped = frozenset(candidate.names) - frozenset(judged.accepted.names)
        rejected |= dropped
        rest = names_of(chosen.terms) - dropped
        alternatives = (s for s in posterior.fitted if not names_of(s.terms) & rejected)
        likelier = next((s for s in alternatives if len(s.terms) <= len(rest)), None)
        if not dropped or likelier is None or names_of(likelier.terms) == rest:
            return min(judgements, key=lambda pair: pair[0])[1]
        chosen = likelier


def _fitted(evaluator: Evaluator, best: Scored) -> FittedModel:
    """A set fitted to all training breaths, with their noise."""
    hypothesis = best.fitted.hypothesis
    if EFFORT in names_of(best.terms):
        hypothesis = hypothesis.plus(Hypothesis((EFFORT,)))
    values = evaluator.transferred(best.fitted, evaluator.training)
    start = {path: x for path, x in values.items() if path.rpartition(".")[0] != EFFORT}
    first = evaluator.fit(hypothesis, best.noise, None, start)
    return fit_with_noise(evaluator, hypothesis, first)


def eliminate(
    evaluator: Evaluator, model: FittedModel, judged: Collection[str] | None = None
) -> tuple[FittedModel, dict[str, float], dict[str, float]]:
    """Drop terms that training and held-out breaths do not both ask for, the least needed first.

    Of a recording with few breaths, each is held out once (cross-validation).

    Args:
        evaluator: evaluator of the recording.
        model: fitted to the training breaths.
        judged: the terms to judge; all if None.

    Returns:
        The rest, and what each of its terms gains on held-out breaths: log-likelihood, nats, and
        root-mean-square error, cmH2O.
    """
    settings = evaluator.settings

    def compared(name: str) -> tuple[Floats, float, bool]:
        reduced = evaluator.fit(model.hypothesis.minus(name), model.noise, model)
        gains = evaluator.held_out_gain(model, reduced)
        before, after = evaluator.mean_square(reduced), evaluator.mean_square(model)
        worth = float(np.sqrt(before) - np.sqrt(after))
        if evaluator.white:  # its likelihood counts a slow error once for each sample
            least = settings.held_out_test.threshold / WARMTH
            helps = worth > 0.0 and float(gains.sum()) > least
            return gains, worth, helps and is_plausible(model, name, settings.plausibility)
        if before - after <= _filtered(evaluator, model) or not is_needed(
            evaluator, model, reduced
        ):
            return gains, worth, False
        if name in basis_terms():
            least = max(settings.search.least_change, 0.5 * model.noise.sigma[0])
            return gains, worth, before - after > least**2 or len(model.names) == 1
        return gains, worth, is_plausible(model, name, settings.plausibility)

    while True:
        results = {n: compared(n) for n in model.names if judged is None or n in judged}
        weak = [name for name, (_, _, supported) in results.items() if not supported]
        if not weak:
            nats = {name: float(gains.sum()) for name, (gains, _, _) in results.items()}
            return model, nats, {name: worth for name, (_, worth, _) in results.items()}
        least = min(weak, key=lambda name: float(results[name][0].sum()))
        model = fit_with_noise(evaluator, model.hypothesis.minus(least), model)


def _gain_sd(evaluator: Evaluator, fitted: FittedModel, sd: float) -> float:
    """Standard deviation of the logarithm of the breaths' gains if held-out breaths ask for it.

    They need not agree, as a spread shows in those that are far off; a tenth of them, which may be
    of another rig, must not decide.
    """
    slopes = evaluator.sensitivities(fitted, evaluator.held_out)[0][:, None]
    linear = evaluator.linearised(fitted, evaluator.held_out)
    gains = np.sort(linear.integrate_out(slopes, np.array([sd]))[0])
    rest = float(gains[: -max(len(gains) // 10, 1)].sum())
    return sd if rest > evaluator.settings.held_out_test.threshold else 0.0


def _swing(evaluator: Evaluator, fitted: FittedModel, term: Term) -> tuple[Swing, Floats]:
    """A periodic input fitted beside a model, and what it gains in each held-out breath, nats.

    Parameters and noise beside it are estimated in turn with its course.
    """
    frequency, spread = term.swing["frequency"], term.swing["spread"]
    training, held_out = evaluator.training, evaluator.held_out

    def at(
        frequency: float, model: FittedModel, partition: Partition
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Log-likelihood, sizes, change of the pressure, and course."""
        values = evaluator.transferred_values(model, partition)
        columns, courses = swing_columns(term.name, partition, values, frequency)
        sds = swing_spreads(columns.shape[1], spread)
        nats, sizes = evaluator.linearised(model, partition).integrate_out(columns, sds)
        change, course = (np.einsum("nk,nkt->nt", sizes, basis) for basis in (columns, courses))
        return nats, sizes, change, course

    beside, data = fitted, training.data
    for _ in range(3):
        change = at(frequency, beside, training)[2][:, None]
        remainder = Partition(replace(data, measured=data.measured - change), training.predictor)
        refit = evaluator.fit(fitted.hypothesis, beside.noise, beside, partition=remainder)
        noise = evaluator.estimate_noise(refit)
        beside = replace(refit, problem=replace(refit.problem, data=data, noise=noise))
    step = 0.02 * frequency
    frequencies = frequency + step * np.arange(-4, 5)
    profile = np.array([float(at(f, beside, training)[0].sum()) for f in frequencies])
    best = int(np.clip(np.argmax(profile), 1, len(frequencies) - 2))
    below, top, above = profile[best - 1 : best + 2]
    curvature = (2.0 * top - below - above) / step**2
    beyond = 0.5 * (above - below) / step / max(curvature, 1e-9)  # the top of their parabola
    frequency = float(frequencies[best] + np.clip(beyond, -step, step))
    _, sizes, _, course = at(frequency, beside, training)
    power = np.mean(sizes**2, axis=0).reshape(2, -1).sum(axis=0)  # of each harmonic
    reported = frequency * (1 + int(np.argmax(power)))
    # Where it is likeliest at an end, no parabola says more than the range.
    sd = reported / frequency * min(float(max(curvature, 1e-9) ** -0.5), float(np.ptp(frequencies)))
    gain, _, change, _ = at(frequency, beside, held_out)
    nats = evaluator.held_out_log_likelihood(beside) + gain
    gained = nats - evaluator.held_out_log_likelihood(fitted)
    less = replace(held_out.data, measured=held_out.data.measured - change[:, None])
    after = evaluator.mean_square(beside, Partition(less, held_out.predictor))
    worth = float(np.sqrt(evaluator.mean_square(fitted)) - np.sqrt(after))
    return Swing(reported, sd, course, beside.noise, nats, worth), gained


def _places(
    posterior: Posterior, names: frozenset[str], place: str, term: str
) -> tuple[tuple[str, float], ...]:
    """Posterior weights of the places of an unnamed effect, the largest first."""
    odds = {place: 1.0}
    for name, ratio in posterior.swaps(names, term).items():
        where = SWINGS[name][0] if name in SWINGS else None
        where = component_of(name) if name in basis_terms() else where
        if where is not None and ratio > _MIN_ODDS:
            odds[where] = odds.get(where, 0.0) + ratio
    total = sum(odds.values())
    return tuple(sorted(((n, p / total) for n, p in odds.items()), key=lambda pair: -pair[1]))


def _alternatives(
    evaluator: Evaluator, posterior: Posterior, names: frozenset[str], named: FittedModel, name: str
) -> Alternatives:
    """Other names of the posterior in the place of one of a set."""
    odds = {
        rival: ratio
        for rival, ratio in posterior.swaps(names, name).items()
        if rival in library() and ratio > _MIN_ODDS
    }
    rivals = (*odds, *(n for n in mechanism(name).description.equivalents if n not in odds))
    models = []
    for rival in list(odds)[:_LISTED]:
        if rival != EFFORT and EFFORT not in named.names:
            hypothesis = named.hypothesis.minus(name).plus(Hypothesis((rival,)))
            models.append(evaluator.fit(hypothesis, named.noise, named))
    return Alternatives(rivals[:_LISTED], posterior.marginal(name), tuple(models))


def _is_unresolved(evaluator: Evaluator, candidate: FittedModel) -> bool:
    """Whether a set explains much of training and held-out breaths though no term is accepted."""
    if not candidate.names or EFFORT in candidate.names:
        return False
    base = evaluator.fit(Hypothesis(), candidate.noise, candidate)
    much = (
        evaluator.criterion(base) - evaluator.criterion(candidate) > evaluator.settings.search.much
    )
    gains = evaluator.held_out_gain(candidate, base)
    much &= float(gains.sum()) > evaluator.settings.held_out_test.threshold
    gained = evaluator.mean_square(base) - evaluator.mean_square(candidate)
    return much and gained > _filtered(evaluator, candidate)


def _filtered(evaluator: Evaluator, model: FittedModel) -> float:
    """Mean square of the error that a filter of the driving flow's noise takes away, cmH2O^2."""
    noise = evaluator.settings.search.drive_noise
    return float(np.mean(np.square(1e-3 * noise * model.column("R")))) if noise else -np.inf


def drop_mechanism(conclusion: Conclusion, name: str, evaluator: Evaluator) -> Conclusion:
    """The conclusion without a mechanism whose strength may as well be none.

    Args:
        conclusion: the conclusion.
        name: name of the mechanism.
        evaluator: evaluator of the conclusion.
    """
    named = conclusion.named
    reduced = fit_with_noise(evaluator, named.hypothesis.minus(name), named)
    full = reduced
    if conclusion.unnamed is not None and conclusion.unnamed.term is not None:
        full = fit_with_noise(evaluator, conclusion.full.hypothesis.minus(name), conclusion.full)
    swing = None if conclusion.unnamed is None else conclusion.unnamed.swing
    return replace(
        conclusion,
        named=reduced,
        full=full,
        noise=full.noise if swing is None else swing.noise,
        held_out_gains={k: v for k, v in conclusion.held_out_gains.items() if k != name},
        alternatives={k: v for k, v in conclusion.alternatives.items() if k != name},
    )
