"""One search by evidence for what a recording needs beyond the base model.

A rig is the base model with a set of terms: mechanisms of the library, basis terms (something
unknown at their place), and what acts in time (:mod:`.in_time`). Around a fit, pressures are linear
in all of them at once (:mod:`.linearised`). What is linear is integrated out, sets of terms are
enumerated by their evidence, the best are fitted and scored again, and around the best fit all
candidates are linearised anew, as long as one more of them is likelier. The answer is the posterior
over all sets that were scored.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.linear import cholesky
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, Partition
from ventbench.diagnosis.in_time import SWINGS, in_time, of_some_breaths, swings, with_course
from ventbench.diagnosis.linearised import (
    CONSTANT,
    EFFORT,
    OPEN,
    SCATTER,
    CandidateEffects,
    LinearModel,
    Set,
    Term,
    gaussian,
    latent_of,
    names_of,
    simulate,
    solve_lower,
    within,
)
from ventbench.diagnosis.screening import screened_points
from ventbench.physics.catalogue import basis_terms, library, mechanism
from ventbench.system_id.data import Data, Noise
from ventbench.system_id.problem import parameter_of

#: Effects of some breaths, and what acts in time of which there is no parameter.
EVENTS = ("cough", *CONSTANT, OPEN)
COMMANDS = ("lost_commands", "late_commands")
IN_TIME = frozenset({*EVENTS, *COMMANDS, *SWINGS})

#: Effects of the muscles, which a test lung has not.
MUSCLES = (EFFORT, "cough", "unknown:muscles")

#: Prior odds of a term, of an unknown at a place beside those of a name, and the power of the
#: likelihood: no model has what neighbouring samples share.
_ODDS, _PLACE, WARMTH = 0.7, 0.1, 0.2

#: Least posterior probability of an effect of some breaths that is looked for.
_LOOKED_FOR = 0.5

#: Standard deviations of the logarithm of the breaths' gains that are compared.
_SCATTERS = (0.003, SCATTER, 0.03, 0.06, 0.1, 0.17, 0.3)


class Scored(NamedTuple):
    """A set of terms with its fit and its evidence, without the linear problem of either."""

    fitted: FittedModel  #: fit of what of the terms is a parameter of the model.
    terms: Set
    noise: Noise
    scatter: float  #: standard deviation of the logarithm of the breaths' gains.
    evidence: float  #: log evidence, nats.
    label: float  #: log prior of the fitted R and C by their labels, nats.

    @property
    def log_prior(self) -> float:
        """Log prior of its names and of the lungs beside them, nats."""
        return prior(names_of(self.terms)) + self.label


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior over the sets of terms that were scored."""

    fitted: tuple[Scored, ...]  #: sets that were fitted, likeliest first.
    weights: Mapping[frozenset[str], float]  #: posterior of each set of names; they add up to 1.

    def marginal(self, *names: str) -> float:
        """Posterior probability that one of these terms acts, over all sets."""
        return float(sum(weight for s, weight in self.weights.items() if not s.isdisjoint(names)))

    @property
    def likely_events(self) -> tuple[str, ...]:
        """Effects of some breaths that may act; lost and late commands are one question."""
        questions = (*((name,) for name in EVENTS), COMMANDS)
        likely = (names for names in questions if self.marginal(*names) > _LOOKED_FOR)
        return tuple(name for names in likely for name in names)

    def swaps(self, names: frozenset[str], name: str) -> dict[str, float]:
        """Posterior odds of others in the place of one term of a set, the likeliest first.

        One may stand in the place of several: equal delays of both valves are a late clock.
        """
        current = self.weights[names]
        odds: dict[str, float] = {}
        for alternative, weight in self.weights.items():
            new = alternative - names
            if name not in alternative and len(new) == 1:
                odds[next(iter(new))] = odds.get(next(iter(new)), 0.0) + weight / current
        return dict(sorted(odds.items(), key=lambda pair: -pair[1]))

    def undecided(self, nats: float) -> Scored:
        """The likeliest term, if none at all is likelier by so little; else the best set.

        A further term beside others may be no more than their form.
        """
        best, *alternatives = self.fitted
        most = _log_posterior(best)
        singles = (s for s in alternatives if len(s.terms) == 1 and not best.terms)
        return next((s for s in singles if most - _log_posterior(s) < nats), best)


def search(wide: Evaluator, also: Sequence[str] = ()) -> Posterior:
    """Find the terms that breaths need.

    Args:
        wide: evaluator with the parameters of all candidates; its training breaths are searched.
        also: names of a set that is fitted in any case.
    """
    return _Search(replace(wide.for_ranking, gain_sd=0.0)).run(also)


def hypothesis_of(terms: Iterable[Term]) -> tuple[Hypothesis, dict[str, float]]:
    """What of a set is a parameter of the model, and values to start its fit from."""
    free, fixed, start, names = [], [], {}, []
    for term in terms:
        if len(term.latent):
            continue
        names.append(term.name)
        for path, value in term.values.items():
            parameter = parameter_of(path)
            if parameter.shape and parameter.grid and parameter.discrete:
                fixed.append((path, float(value)))
                continue
            start[path] = float(np.clip(value, parameter.low, parameter.high))
            if parameter.shape and not (parameter.grid and parameter.discrete):
                free.append(path)
    return Hypothesis(tuple(names), tuple(free), tuple(fixed)), start


def prior(names: Iterable[str], warmth: float = 1.0) -> float:
    """Log prior of a set of names.

    Args:
        names: the set.
        warmth: power of the likelihood that it is weighed against. Beside a whole likelihood, which
            is surer than any model is, an unknown at a place must be as much less likely.
    """
    per_term, unknown = np.log(_ODDS / len(library())), np.log(_PLACE) / warmth
    return float(sum(per_term + unknown * (n in basis_terms() or ":" in n) for n in names))


def evidence(G: Floats, b: Floats, terms: Set) -> float:
    """Log evidence of a set of terms over none, with deviations of their forms."""
    value, means = 0.0, [0.0] * len(terms)
    for _ in range(2 if any(term.forms for term in terms) else 1):
        index: list[int] = []
        spread: list[float] = []
        leading = []
        for term, mean in zip(terms, means, strict=True):
            leading.append(len(index))
            index += [*term.main, *(term.forms if mean else ())]
            spread += [*term.spread, *(abs(mean) * c for c in term.forms.values() if mean)]
        value, coefficients, sds = gaussian(G[np.ix_(index, index)], b[index], np.array(spread))
        means = [float(coefficients[k]) for k in leading]
    for k, term in zip(leading, terms, strict=True):
        value += term.odds
        if np.isfinite(term.limits[0]):
            value += within(term.limits, float(coefficients[k]), float(sds[k]), 0.0, term.spread[0])
    return value


def enumerate_sets(
    model: LinearModel, latent: Sequence[Term], most: int, beam: int
) -> list[tuple[float, Set]]:
    """Sets of terms by log posterior over the empty one, likeliest first, one of each names.

    Args:
        model: the linearised experiment.
        latent: terms that act in time.
        most: most terms of a set.
        beam: sets of each size that are extended.
    """
    columns, numbered = [*model.around.columns], []
    for term in latent:
        indices = tuple(range(len(columns), len(columns) + len(term.latent)))
        numbered.append(replace(term, main=indices))
        columns += term.latent
    weight = model.around.data.weight
    G, b = model.products(model.rows(np.stack(columns, axis=1) * weight))
    best: dict[frozenset[str], tuple[float, Set]] = {frozenset(): (0.0, ())}

    beside = {term.name: _marginalise(G, b, term) for term in numbered}

    def score(terms: Set) -> float:
        wide = max(terms, key=lambda term: len(term.latent))
        if len(wide.latent):
            marginal, information, rest = beside[wide.name]
            value = marginal + evidence(
                information, rest, tuple(term for term in terms if term is not wide)
            )
        else:
            value = evidence(G, b, terms)
        key = names_of(terms)
        total = value + prior(key, WARMTH)
        if len(key) == len(terms) and (key not in best or total > best[key][0]):
            best[key] = (total, terms)
        return value

    ranked: dict[str, list[tuple[float, Term]]] = {}
    for term in (*model.around.terms, *numbered):
        ranked.setdefault(term.name, []).append((score((term,)), term))
    for candidates in ranked.values():
        candidates.sort(key=lambda pair: -pair[0])
    shortlist = {name: [term for _, term in candidates[:2]] for name, candidates in ranked.items()}

    def top(size: int, count: int) -> list[Set]:
        same_size = [pair for key, pair in best.items() if len(key) == size]
        return [terms for _, terms in sorted(same_size, key=lambda pair: -pair[0])[:count]]

    for size in _sizes(best, most):
        sets = (
            [(t,) for candidates in shortlist.values() for t in candidates]
            if size == 2
            else top(size - 1, beam)
        )
        for terms in sets:
            for name in shortlist.keys() - names_of(terms):
                for term in shortlist[name] if size > 2 or name > terms[0].name else ():
                    score((*terms, term))
        for terms in top(size, beam // 3):
            for k, term in enumerate(terms):
                for _, alternative in ranked[term.name]:
                    score((*terms[:k], alternative, *terms[k + 1 :]))
    return sorted(best.values(), key=lambda pair: -pair[0])


def _sizes(best: Mapping[frozenset[str], tuple[float, Set]], most: int) -> Iterator[int]:
    """Sizes of sets to score, as long as a term more made the likeliest set likelier.

    Fits are extended by single terms afterwards, whatever was scored.
    """
    for size in range(2, most + 1):
        fewer, last = (
            max(value for key, (value, _) in best.items() if len(key) == n)
            for n in (size - 2, size - 1)
        )
        if size > 2 and last <= fewer:
            return
        yield size


def _log_posterior(scored: Scored) -> float:
    """Log posterior of a set that was fitted, but for a constant, nats."""
    return scored.evidence + prior(names_of(scored.terms), WARMTH) + scored.label


def _marginalise(G: Floats, b: Floats, term: Term) -> tuple[float, Floats, Floats]:
    """Log evidence of a term, and the products with its coefficients integrated out."""
    at, sd = list(term.main), np.array(term.spread)
    L = cholesky(np.eye(len(at)) + sd[:, None] * G[np.ix_(at, at)] * sd)
    R = solve_lower(L, sd[:, None] * np.column_stack([G[at], b[at]]))
    explained = R.T @ R
    return evidence(G, b, (term,)), G - explained[:-1, :-1], b - explained[:-1, -1]


class _View(NamedTuple):
    """A linearisation, and its sets of terms."""

    base: FittedModel
    around: CandidateEffects
    noise: Noise
    scatters: tuple[float, ...]  #: of the gains, that are compared.
    ranked: tuple[list[tuple[float, Set]], ...]  #: ranked sets at each scatter.
    latent: Sequence[Term]  #: what may act in time.


class _Search:
    """The steps of a search."""

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator, self.settings = evaluator, evaluator.settings.search
        self.predictor = evaluator.training.predictor
        self.excluded = evaluator.excluded
        self.names = [n for n in library() if n not in self.excluded and n != EFFORT]
        self.unnamed = self.settings.nonparametric_terms
        if self.unnamed is None:
            self.unnamed = tuple(basis_terms())
        self.scored: dict[frozenset[str], Scored] = {}
        self.contenders: set[frozenset[str]] = (
            set()
        )  # of those, those whose evidence is within the margin of the best

    def run(self, also: Sequence[str]) -> Posterior:
        """Search."""
        data, first = self.evaluator.training.data, self.fit(())
        data = mask_spikes(first, data)
        noise = self.evaluator.estimate_noise(self.fit((), data))
        self.data, self.base = data, self.fit((), data, noise)
        views = [self.view(self.base, noise)]
        if self.deviates_from_label(self.base):
            views.append(self.view(self.at_label(noise), noise))
        for view in views:
            self.scatters = view.scatters
            leading = [sets for ranking in view.ranked for _, sets in ranking[: self.settings.fits]]
            for terms in {names_of(terms): terms for terms in leading}.values():
                self.attempt(view.around, view.noise, terms, view.base)
        main = min(views, key=lambda view: float(view.noise.log_scale(data.weight).sum()))
        around, noise, self.scatters = main.around, main.noise, main.scatters
        handled = {*self.excluded, *names_of(main.latent)}
        self.refused = [name for name in SWINGS if name not in handled]
        self.muscles = [term for term in main.latent if term.name in MUSCLES[:-1]]
        self.scored[frozenset()] = self.score(self.linear_model(around, self.base, noise))
        self.contenders.add(frozenset())
        self.rescore(around, noise)
        if also:
            points = [t for n in also for t in around.terms if t.name == n]
            terms = tuple({t.name: t for t in reversed(points)}.values())
            self.attempt(around, noise, terms, self.base)
        expanded: dict[frozenset[str], tuple[CandidateEffects, Noise]] = {
            frozenset(): (around, noise)
        }
        for _ in range(2 * self.settings.most_terms):
            chosen = next((s for s in self.leading() if names_of(s.terms) not in expanded), None)
            if chosen is None:
                break
            expanded[names_of(chosen.terms)] = self.extend(chosen, noise)
            around, noise = expanded.get(names_of(self.ordered()[0].terms), (around, noise))
            self.rescore(around, noise)
        ordered = self.ordered()
        ranked = main.ranked[main.scatters.index(ordered[0].scatter)]
        return Posterior(tuple(ordered), weigh(ordered, ranked))

    def leading(self) -> list[Scored]:
        """The likeliest set, and the likeliest of names alone if it is not far behind."""
        ordered = self.ordered()
        named = [s for s in ordered if not names_of(s.terms) & basis_terms().keys()]
        close = [s for s in named[:1] if ordered[0].evidence - s.evidence < self.settings.much]
        return [ordered[0], *close]

    def extend(self, chosen: Scored, noise: Noise) -> tuple[CandidateEffects, Noise]:
        """Fit sets with one term more, less or other, and return what they were chosen by."""
        around, names = self.around(chosen.fitted), names_of(chosen.terms)
        model = self.linear_model(around, chosen.fitted, noise, chosen.terms, loose=True)
        noise = self.evaluator.colour(model.residual_noise)
        if len(names) < self.settings.most_terms:
            model = self.linear_model(around, chosen.fitted, noise, chosen.terms)
            more = enumerate_sets(model, self.events(model), 1, self.settings.beam)
            for terms in [t for _, t in more if t and not names_of(t) & names][:3]:
                self.attempt(around, noise, (*chosen.terms, *terms), chosen.fitted, new=True)
        for term in chosen.terms:
            rest = tuple(t for t in chosen.terms if t is not term)
            self.attempt(around, noise, rest, chosen.fitted, new=True)
            if term.name in basis_terms():
                self.name(term.name, rest, noise)
            if term.name in EVENTS and names_of(rest) in self.scored:
                # The breaths in which it acts, beside the rest.
                reduced = self.scored[names_of(rest)]
                model = self.linear_model(self.around(reduced.fitted), reduced.fitted, noise, rest)
                for alternative in self.events(model):
                    if alternative.name == term.name:
                        self.attempt(model.around, noise, (*rest, alternative), reduced.fitted)
            for alternative in self.muscles if term.name == MUSCLES[-1] else ():
                self.attempt(around, noise, (*rest, alternative), self.base, new=True)
        return around, noise

    def name(self, unknown: str, rest: Set, noise: Noise) -> None:
        """Fit the likeliest mechanisms in the place of a basis term that contains them."""
        reduced = self.scored.get(names_of(rest))
        if reduced is None:
            return
        around = self.around(reduced.fitted)
        model = self.linear_model(around, reduced.fitted, noise, rest)
        special = {
            n for n in self.names if unknown in mechanism(n).description.special_case_of
        } - names_of(rest)
        terms = [t[0] for _, t in enumerate_sets(model, (), 1, 1) if t and t[0].name in special]
        for term in terms[: self.settings.fits - 1]:
            self.attempt(around, noise, (*rest, term), reduced.fitted, new=True)

    def events(self, model: LinearModel) -> list[Term]:
        """Effects of some breaths beside a fit, and swings that commands predicted before it."""
        partition = Partition(self.data, self.predictor)
        terms = of_some_breaths(model, partition, self.excluded, self.evaluator.settings)
        return [
            *terms,
            *(
                with_course(t, self.evaluator.settings)
                for t in swings(model, partition, self.refused)
            ),
        ]

    def around(self, fitted: FittedModel) -> CandidateEffects:
        """All candidates, simulated around a fit."""
        events = [name for name in EVENTS if name not in self.excluded]
        screened = {
            name: screened_points(fitted, name)
            for name in self.names
            if any(p.screened for p in mechanism(name).description.parameters)
            and name not in fitted.names
        }
        unnamed = self.unnamed or ()
        return simulate(self.data, self.predictor, fitted, self.names, unnamed, events, screened)

    def linear_model(
        self,
        around: CandidateEffects,
        fitted: FittedModel,
        noise: Noise,
        terms: Set = (),
        *,
        loose: bool = False,
    ) -> LinearModel:
        """A linearised fit at the scatter of the gains that is likelier beside it.

        A drift of the gain is scatter, too, until it is among the terms.
        """
        models = (
            LinearModel(around, fitted, self.base, noise, terms, scatter=scatter, loose=loose)
            for scatter in self.scatters
        )
        return max(models, key=lambda model: model.evidence)

    def score(self, model: LinearModel) -> Scored:
        """A set by its evidence, and by the labels of its lungs."""
        label = self.evaluator.label_log_density(model.fitted)
        return Scored(model.fitted, model.terms, model.noise, model.scatter, model.evidence, label)

    def fit(
        self,
        terms: Set,
        data: Data | None = None,
        noise: Noise | None = None,
        warm_start: FittedModel | None = None,
    ) -> FittedModel:
        """Fit what of a set is a parameter of the model, from where the linear problem has it."""
        partition = self.evaluator.training
        if data is not None:
            partition = Partition(data, self.predictor)
        hypothesis, start = hypothesis_of(terms)
        return self.evaluator.fit(
            hypothesis, noise or Noise(), warm_start, start or None, partition=partition
        )

    def view(self, base: FittedModel, noise: Noise) -> _View:
        """Sets of terms by a linearisation around a base model."""
        around, self.scatters = self.around(base), _SCATTERS
        likeliest = self.linear_model(around, base, noise, loose=True).scatter
        self.scatters = tuple(sorted({min(SCATTER, likeliest), likeliest}))
        for _ in range(2):
            loose = self.linear_model(around, base, noise, loose=True)
            noise = self.evaluator.colour(loose.residual_noise)
        model = self.linear_model(around, base, noise)
        latent = in_time(
            model,
            Partition(self.data, self.predictor),
            base,
            self.excluded,
            self.evaluator.settings,
        )
        ranked = [
            enumerate_sets(
                LinearModel(around, base, self.base, noise, scatter=scatter),
                latent,
                3,
                self.settings.beam,
            )
            for scatter in self.scatters
        ]
        return _View(base, around, noise, self.scatters, tuple(ranked), latent)

    def deviates_from_label(self, base: FittedModel) -> bool:
        """Whether the base model makes up for much by R or C."""
        ratios = [base.column(path) / getattr(self.data, path) for path in ("R", "C")]
        return bool(np.max(np.abs(np.log(ratios))) > np.log(self.settings.label_factor))

    def at_label(self, noise: Noise) -> FittedModel:
        """The base model with the labels' R and C: lags of 0.1 s take R to nothing."""
        return self.evaluator.fit(
            Hypothesis(),
            noise,
            None,
            {"R": self.data.R, "C": self.data.C},
            partition=Partition(self.data, self.predictor),
            iterations=0,
        )

    def attempt(
        self,
        around: CandidateEffects,
        noise: Noise,
        terms: Set,
        start: FittedModel,
        *,
        new: bool = False,
    ) -> None:
        """Fit a set, or only a new one.

        What acts in time is taken from the readings before a second fit.
        """
        if not terms or (new and self.is_scored(terms, start)):
            return
        fitted, reduced, latent = start, self.data, latent_of(terms)
        for k in range(2 if latent else 1):
            if k or len(terms) > len(latent):
                fitted = self.fit(terms, reduced, noise, fitted)
            elif start is not self.base:
                fitted = self.base
            if not all(np.isfinite(part).all() for part in fitted.jacobian):
                return  # the model cannot simulate it
            model = self.linear_model(around, fitted, noise, terms)
            reduced = replace(self.data, measured=self.data.measured - model.in_time[:, None])
        before, now = self.scored.get(names_of(terms)), self.score(model)
        if before is not None:
            before = self.score(self.linear_model(around, before.fitted, noise, terms))
        if before is None or _log_posterior(before) < _log_posterior(now):
            self.scored[names_of(terms)] = now
            self.contenders.add(names_of(terms))

    def is_scored(self, terms: Set, start: FittedModel) -> bool:
        """Whether a set was fitted, and not worse than what another fit would start it from."""
        scored = self.scored.get(names_of(terms))
        if scored is None:
            return False
        problem, minimum = scored.fitted.problem, scored.fitted.minimum
        x = problem.start({path: start.column(path) for path in start.problem.unknowns.paths})
        return bool(problem.cost(x) >= minimum.cost)

    def rescore(self, around: CandidateEffects, noise: Noise) -> None:
        """Score all sets alike, but for those that are far behind."""
        for key in self.contenders:
            s = self.scored[key]
            self.scored[key] = self.score(self.linear_model(around, s.fitted, noise, s.terms))
        most = max(self.scored[key].evidence for key in self.contenders)
        margin = self.settings.far_behind
        self.contenders = {
            key for key in self.contenders if self.scored[key].evidence > most - margin
        }

    def ordered(self) -> list[Scored]:
        """Sets that were fitted and are not far behind, likeliest first."""
        return sorted(
            (self.scored[key] for key in self.contenders), key=_log_posterior, reverse=True
        )


def likeliest_sets(
    weights: Mapping[frozenset[str], float], count: int = 60
) -> tuple[tuple[tuple[str, ...], float], ...]:
    """The likeliest sets of terms with their probabilities, the likeliest first."""
    most = sorted(weights.items(), key=lambda pair: -pair[1])[:count]
    return tuple((tuple(sorted(names)), weight) for names, weight in most)


def mask_spikes(fitted: FittedModel, data: Data) -> Data:
    """Take the weight off single readings that are far off, away from edges of the valves."""
    r = fitted.residual[:, 0] * data.weight[:, 0]
    deviation = np.abs(r - np.median([np.roll(r, k, axis=1) for k in (-2, -1, 0, 1, 2)], axis=0))
    size = 1.4826 * float(np.median(deviation[data.weight[:, 0] > 0])) + 0.05
    edge = np.abs(np.diff(data.u_out, axis=1, prepend=data.u_out[:, :1])) > 0
    outlier = (deviation > 8.0 * size) & ~np.any(
        [np.roll(edge, k, axis=1) for k in range(-2, 4)], axis=0
    )
    outlier[:, :4] = outlier[:, -2:] = False
    return replace(data, weight=data.weight * ~outlier[:, None])


def weigh(
    scored: Sequence[Scored], linear: Sequence[tuple[float, Set]]
) -> dict[frozenset[str], float]:
    """Posterior of each set of names; the likeliest that was not fitted is a nat behind."""
    logs = {names_of(s.terms): WARMTH * s.evidence + s.log_prior for s in scored}
    at = {}
    for value, terms in linear:
        names = names_of(terms)
        at[names] = WARMTH * (value - prior(names, WARMTH)) + prior(names)
    offset = max(logs.values()) - 1.0 - max(at.values())
    for names, value in at.items():
        logs.setdefault(names, value + offset)
    odds = np.exp(np.array(list(logs.values())) - max(logs.values()))
    return dict(zip(logs, (odds / odds.sum()).tolist(), strict=True))
