"""Effects that act in some breaths only: a mechanism, and in each breath whether it acts.

An effect of the catalogue's events has parameters of each breath. With the likelihood ``L_b(z)`` of
a breath in which it acts with the parameters ``z``, and ``L_b`` of one in which it does not, the
breaths are a mixture,

    p(breath b) = (1 - share) L_b + share sum_z p(z) L_b(z),

a spike and a slab. Onsets and durations are uniform on the grid of the event's file, strengths
lie around one of all affected breaths (a normal density of their logarithm). That strength and the
share are the likeliest on the training breaths. Parameters that breaths share are fitted to the
breaths in which the effect does not act, in turn with the question which these are. Commands that
were lost or late have no grid: each of them was followed or not (:mod:`.in_time`).

The effect acts beside the mechanisms that the search has named. It is told if it predicts breaths,
each left out once, better than these alone and than an error that nobody can place. A set of
breaths that begins or ends at one breath of the recording is a change of the session and no such
effect; one that commands predict is physics. The breaths that are affected are then set aside, or
get the commands that reached the valve, and the rest of the diagnosis goes on without the effect.
Breaths that judge are none of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Floats
from ventbench.diagnosis.evaluator import Evaluator, fit_with_noise
from ventbench.diagnosis.evidence import COMMANDS
from ventbench.diagnosis.findings import MissingMechanism
from ventbench.diagnosis.hypothesis import FittedModel, Partition, linearise
from ventbench.diagnosis.identification import IdentifiedModel
from ventbench.diagnosis.in_time import EXCHANGEABLE, Paths, ask_for_little, command_p_value, follow
from ventbench.diagnosis.linearised import OPEN
from ventbench.diagnosis.unknown import explained, mixture, preference, unplaced_gain
from ventbench.diagnosis.validation import order_p_value
from ventbench.mechanics.labels import Estimate
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.data import Data
from ventbench.system_id.predictor import START
from ventbench.system_id.problem import Problem, make_problem

#: Shares of the breaths that are tried; more than half of the breaths is not "some".
_SHARES = np.array([0.03, 0.08, 0.15, 0.25, 0.4, 0.6])

#: Standard deviation of the logarithm of strengths between affected breaths.
_SPREAD = 0.3

#: Multiples of the strength that refine it; most alternations of fit and affected breaths, and
#: change of a start, cmH2O, at which that of commands and starts ends.
_MULTIPLES, _ROUNDS, _SETTLED = np.geomspace(0.6, 1.0 / 0.6, 9), 4, 0.02

#: Fewest breaths that must not be affected.
_MIN_UNAFFECTED = 4

#: p-value below which affected breaths have an order in time.
_ORDERED = 0.002

#: Samples by which commands may be late, least share of them that are lost or late, and nats by
#: which two delays are alike.
_LAGS, _RARE, _TIE = (2, 3, 4, 5), 0.003, 2.0

#: Nats within which another effect is an alternative; a posterior probability of 1 : 150.
_CLOSE = 5.0

#: Steps between the points of a grid, as shares of its own, by which a breath's course and strength
#: are refined. Each halves the cell of the likeliest point in all of its dimensions.
_MOVES = (-1.0, 0.0, 1.0)
_FINER = (0.5, 0.25, 0.125, 0.0625)

#: Multiples of the noise by which an affected breath may err, as the form of an effect is not
#: known; a breath may err more than others without any.
_ROUGH = np.array([1.0, 2.0, 4.0, 8.0])

#: Simulations of all breaths that are kept at once.
_AT_ONCE = 16


@dataclass(frozen=True, eq=False)
class Intermittent:
    """An effect that acts in some breaths."""

    missing: MissingMechanism  #: its finding, with the ids of the breaths that are affected.
    affected: Bools  #: which of the n breaths are, ``(n,)``.
    #: commands that reached the valve, %, ``(n, T)``; None if the affected breaths are to be set
    #: aside.
    u_in: Floats | None


class _EventFit(NamedTuple):
    """An effect fitted to the training breaths."""

    evaluator: Evaluator  #: evaluator of the recording.
    name: str  #: name of the event.
    fitted: FittedModel  #: the model of the breaths without it.
    strength: int  #: index of the strength; samples by which commands are late, 0 if they are lost.
    share: float  #: share of the breaths, or of the commands.
    #: log-likelihood of each training breath by what the others say of the effect, ``(n,)``.
    left_out: Floats
    held_out: Floats  #: log-likelihood of each held-out breath, ``(h,)``.

    @property
    def total(self) -> float:
        """Log-likelihood of training and held-out breaths, nats."""
        return float(self.left_out.sum() + self.held_out.sum())


def find(model: IdentifiedModel, data: Data, ids: NDArray[np.int_]) -> Intermittent | None:
    """The effect of some breaths that a recording needs more than all that was identified.

    Args:
        model: model identified from some of the breaths.
        data: all n breaths.
        ids: their ids, ``(n,)``.
    """
    evaluator, conclusion = model.evaluator, model.conclusion
    hypothesis, likely = conclusion.named.hypothesis, conclusion.posterior.likely_events
    if not likely and conclusion.unnamed is None and not conclusion.names:
        likely = COMMANDS  # rare ones may be in none of the breaths that were searched
    if not likely:
        return None
    rest = hypothesis.minus(*hypothesis.breath_terms)
    alone = fit_with_noise(evaluator, rest, conclusion.named)  # which has the place of a change
    names = {*likely} - {*COMMANDS}
    # An open tube is far from linear, so that the search may take it for another event.
    candidates = [
        candidate
        for name in sorted(names | {OPEN} if names else ())
        if (candidate := _fit(evaluator, alone, name)) is not None
    ]
    if len(names) < len(likely):
        candidates += _fit_commands(evaluator, alone)
    candidates.sort(key=lambda candidate: -candidate.total)
    if not candidates:
        return None
    best, full = candidates[0], conclusion.full
    swing = None if conclusion.unnamed is None else conclusion.unnamed.swing
    if swing is None:  # what acts in few breaths may act in none of the held-out ones
        tested, total = _joined(evaluator, evaluator.training, evaluator.held_out), best.total
        gained = total - float(evaluator.log_likelihood(full, tested).sum())
    else:
        tested, total = evaluator.held_out, float(best.held_out.sum())
        gained = total - float(swing.held_out_log_likelihood.sum())
    unplaced = float(evaluator.log_likelihood(alone, tested).sum())
    unplaced += unplaced_gain(evaluator, alone, tested)
    if gained <= evaluator.settings.search.course_nats or total <= unplaced:
        return None
    odds: dict[str, float] = {}
    for candidate in candidates:
        odds[candidate.name] = odds.get(candidate.name, 0.0) + float(
            np.exp(candidate.total - best.total)
        )
    affected, u_in, estimates = _everywhere(best, data)
    if not affected.any():
        return None
    least_odds, (worth, share) = np.exp(-_CLOSE), explained(evaluator, full, tested, gained)
    missing = MissingMechanism(
        best.name,
        estimates,
        odds[best.name] / sum(odds.values()) * preference(min(total - unplaced, gained)),
        tuple(name for name, value in odds.items() if value > least_odds and name != best.name),
        gained,
        worth=worth,
        explains=share,
        affected=tuple(int(i) for i in ids[affected]),
    )
    return Intermittent(missing, affected, u_in)


def _is_change(affected: Bools, evaluator: Evaluator, data: Data) -> bool:
    """Whether affected breaths have an order in time, as after a change of the session."""
    if np.count_nonzero(np.diff(affected.astype(int))) == 1:
        return True
    ranked = affected + 1e-3 * np.random.default_rng(0).uniform(size=len(affected))  # no ties
    return order_p_value(ranked, data.lung, evaluator.settings.residuals) < _ORDERED


def _joined(evaluator: Evaluator, first: Partition, second: Partition) -> Partition:
    """The breaths of both."""
    pairs = zip(vars(first.data).items(), vars(second.data).values(), strict=True)
    joined = {name: np.concatenate([mine, theirs]) for (name, mine), theirs in pairs}
    return evaluator.partition(Data(**joined))


def _fit(evaluator: Evaluator, alone: FittedModel, name: str) -> _EventFit | None:
    """Fit an effect beside a model of all training breaths; None if it acts in no breath.

    The first breaths are found at white noise, as coloured noise excuses whole breaths. Where most
    breaths are affected, the model is one of these, and the others show the opposite effect.
    """
    training = evaluator.training
    fitted = evaluator.fit(alone.hypothesis, alone.noise.white, alone if alone.names else None)
    affected = np.zeros(len(training.data), bool)
    for k in range(_ROUNDS):
        evidence = _Evidence.of(evaluator, fitted, training, name)
        strength, share, nats = evidence.likeliest()
        acts = evidence.acts(strength, share)
        against = [-s for s in evidence.strengths if -s >= mechanism(name).description.strength.low]
        if k == 0 and against:
            opposite = _Evidence.of(evaluator, fitted, training, name, tuple(against))
            opposite_strength, opposite_share, more = opposite.likeliest()
            if more > nats:
                acts = ~opposite.acts(opposite_strength, opposite_share)
        if np.array_equal(affected, acts):
            break
        if (~acts).sum() < _MIN_UNAFFECTED or not acts.any():
            return None
        affected, rest = acts, evaluator.partition(training.data.select(~acts))
        start = evaluator.transferred(fitted, rest)
        now = replace(evaluator, training=rest, folds=())
        fitted = fit_with_noise(
            now, alone.hypothesis, now.fit(alone.hypothesis, fitted.noise, start=start)
        )
    left_out = evidence.plain + evidence.left_out()
    if not affected.any():
        return None
    evidence = _Evidence.of(evaluator, fitted, evaluator.held_out, name)
    held_out = evidence.plain + mixture(share, evidence.acting()[strength])
    return _EventFit(evaluator, name, fitted, strength, share, left_out, held_out)


def _fit_commands(evaluator: Evaluator, alone: FittedModel) -> list[_EventFit]:
    """Lost and late commands beside a model of all training breaths."""
    training, fitted, share, candidates = evaluator.training, alone, float(_SHARES[1]), []
    least = float(evaluator.log_likelihood(alone, training).sum())
    for k in range(_ROUNDS):
        paths = _paths(evaluator, fitted, training, share, 0)
        share = float(np.clip(paths.missed.sum() / max(paths.sent.sum(), 1.0), _RARE, _SHARES[-1]))
        # At a share that is too large each command that came costs: rare losses would be none.
        if not k:
            paths = _paths(evaluator, alone, training, share, 0)
            if paths.nats.sum() < least:
                return candidates  # late ones seem lost, too
        now = replace(evaluator, training=_with_commands(evaluator, training, paths))
        before, fitted = fitted, fit_with_noise(now, alone.hypothesis, fitted)
        if not paths.missed.any() or before.noise == fitted.noise:
            break
    for lag in (0, *_LAGS):
        nats, tested = (
            _paths(evaluator, fitted, breaths, share, lag).nats
            for breaths in (training, evaluator.held_out)
        )
        if lag:  # each delay is as likely
            nats = nats - np.log(len(_LAGS)) / len(nats)
        candidates.append(_EventFit(evaluator, COMMANDS[lag > 0], fitted, lag, share, nats, tested))
    return candidates


def _paths(
    evaluator: Evaluator, fitted: FittedModel, partition: Partition, share: float, lag: int
) -> Paths:
    """The commands that reached the valve in breaths whose shared parameters are known."""
    problem, x = _from_first_readings(evaluator, fitted, partition)
    for _ in range(_ROUNDS):  # the start is that of a breath with the commands that reached it
        paths = follow(problem, x, partition, share, lag or None)
        reached, before = _with_commands(evaluator, partition, paths), x
        x = evaluator.refit_breath_parameters(fitted, reached)[1]
        if np.allclose(x, before, rtol=0.0, atol=_SETTLED):
            break
    return paths


def _with_commands(evaluator: Evaluator, partition: Partition, paths: Paths) -> Partition:
    return evaluator.partition(replace(partition.data, u_in=paths.u_in))


def _from_first_readings(
    evaluator: Evaluator, fitted: FittedModel, partition: Partition
) -> tuple[Problem, Floats]:
    """Breaths that start at their first readings, with the gain of their lung.

    A start or a gain that was fitted without an effect makes up for it.
    """
    fixed = evaluator.transferred(fitted, partition)
    problem = make_problem(partition, (START,), fitted.noise, fixed, evaluator.gain_sd)
    return problem, problem.start({})


def _everywhere(
    candidate: _EventFit, data: Data
) -> tuple[Bools, Floats | None, dict[str, Estimate]]:
    """In which of n breaths the effect acts, with which commands, and how strong it is.

    In none if commands or the course of the session tell which: then it is another effect.
    """
    evaluator, name = candidate.evaluator, candidate.name
    partition = evaluator.partition(data)
    if name in COMMANDS:
        paths = _paths(evaluator, candidate.fitted, partition, candidate.share, candidate.strength)
        if ask_for_little(paths, data.u_in) <= EXCHANGEABLE:
            return np.zeros(len(data), bool), None, {}
        missed, sent = int(paths.missed.sum()), max(int(paths.sent.sum()), 1)
        p, width = missed / sent, 1.96 * np.sqrt(missed + 1.0) / sent
        estimates = {"share": Estimate(p, "1", (max(p - width, 0.0), min(p + width, 1.0)))}
        if candidate.strength:
            dt = float(np.median(data.dt[:, :-1]))
            profile = [
                _paths(evaluator, candidate.fitted, partition, candidate.share, k).nats.sum()
                for k in _LAGS
            ]
            likely = np.array(_LAGS)[np.array(profile) > max(profile) - _TIE]
            ends = (float(likely[0] - 1) * dt, float(likely[-1]) * dt)
            estimates["delay"] = Estimate(0.5 * sum(ends), "s", ends)
        return paths.missed > 0, paths.u_in, estimates
    evidence = _Evidence.of(evaluator, candidate.fitted, partition, name)
    acts = evidence.acts(candidate.strength, candidate.share)
    likely = evidence.chances(candidate.strength, candidate.share)
    pressure = evaluator.predict(candidate.fitted, partition)[:, 0]
    commanded = command_p_value(likely, data, pressure) <= EXCHANGEABLE
    if commanded or _is_change(acts, evaluator, data):
        return np.zeros_like(acts), None, {}
    strength, centre = mechanism(name).description.strength, evidence.strengths[candidate.strength]
    if len(evidence.strengths) < 2 or not acts.any():
        return acts, None, {}
    some = evaluator.partition(data.select(acts))
    fine = _Evidence.of(evaluator, candidate.fitted, some, name, tuple(centre * _MULTIPLES))
    logs = np.log(centre * _MULTIPLES)
    marginal = np.logaddexp.reduce(fine.nats, axis=1)  # whatever its course
    weights = np.exp(marginal - np.logaddexp.reduce(marginal, axis=0))  # (s, k)
    means = logs @ weights
    step = logs[1] - logs[0]
    width = np.sqrt(np.maximum(logs**2 @ weights - means**2, step**2 / 12.0) + np.var(means))
    middle, sd = np.average(means, weights=width**-2.0), np.sum(width**-2.0) ** -0.5
    value, low, high = np.exp(middle + 1.96 * sd * np.array([0.0, -1.0, 1.0]))
    estimate = Estimate(float(value), strength.unit, (float(low), float(high)))
    return acts, None, {strength.name: estimate}


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What an effect does for the log-likelihood of n breaths."""

    strengths: tuple[float, ...]  #: the s strengths that were tried.
    nats: Floats  #: gain of each breath at each strength and each of g courses, ``(s, g, n)``.
    rough: Floats  #: gain of each breath if it only errs more than others, ``(n,)``.
    #: log-likelihood of each breath in which the effect does not act, nats, ``(n,)``.
    plain: Floats

    @classmethod
    def of(
        cls,
        evaluator: Evaluator,
        fitted: FittedModel,
        partition: Partition,
        name: str,
        strengths: tuple[float, ...] | None = None,
    ) -> _Evidence:
        """Simulate the effect in breaths whose shared parameters are known.

        What each breath has of its own, its start and perhaps its gain, is refitted to first order.
        """
        problem, x = _from_first_readings(evaluator, fitted, partition)
        linear = linearise(problem, x, clip=np.inf)
        strength, *secondary = mechanism(name).description.parameters
        strengths = strengths or strength.scan
        scanned = np.array(strengths)
        gridded = [p for p in secondary if p.grid]
        grids = [p.grid for p in gridded]
        columns = [partition.predictor.names.index(f"{name}.{p.name}") for p in gridded]
        strength_column = partition.predictor.names.index(f"{name}.{strength.name}")
        count = problem.data.weight.sum(axis=(1, 2))

        def density(white: Floats, scales: Floats) -> Floats:
            """Logarithm of the mean density of residuals ``(n, q, m)`` over the scales, (n, q)."""
            densities = [
                -problem.noise.loss(white / k).sum(axis=2) - count[:, None] * np.log(k)
                for k in scales
            ]
            return np.logaddexp.reduce(densities, axis=0) - np.log(len(scales))

        plain = density(linear.residual[:, None], _ROUGH[:1])
        rough = (density(linear.residual[:, None], _ROUGH[1:]) - plain)[:, 0]

        def gained(courses: Floats) -> Floats:
            """Gain ``(s, k, n)`` at each strength and k courses of each breath, (s, k, n, g)."""
            points = np.tile(linear.values, (*courses.shape[:2], 1, 1))
            points[..., strength_column] = scanned[:, None, None] * np.exp(courses[..., -1])
            points[..., columns] = courses[..., :-1]
            points, parts = points.reshape(-1, *linear.values.shape), []
            for k in range(0, len(points), _AT_ONCE):
                predicted = partition.predictor.predict_all(points[k : k + _AT_ONCE])
                change = np.moveaxis(predicted - linear.prediction, 0, 1)
                change = linear.whiten(change)  # (n, q, m)
                residuals = linear.residual[:, None] + linear.project_out_breath(change)
                parts.append((density(residuals, _ROUGH) - plain).T)
            return np.nan_to_num(np.concatenate(parts), nan=-np.inf).reshape(courses.shape[:3])

        grid = np.array(list(product(*grids, (0.0,))))
        shape = (len(strengths), len(grid), len(problem.data), grid.shape[1])
        nats = gained(np.broadcast_to(grid[:, None], shape))
        best = np.argmax(nats, axis=1)[:, None]  # (s, 1, n)
        course, top = grid[best], np.take_along_axis(nats, best, axis=1)
        moves = np.array(list(product(*((0.0,) if p.shape else _MOVES for p in gridded), _MOVES)))
        apart = np.gradient(np.log(np.abs(scanned))) if len(strengths) > 1 else np.zeros(1)
        volume = -np.log(len(moves)) / np.log(len(_MOVES)) * np.log(2.0)
        for level, finer in enumerate(_FINER, 1):  # between the points of the grid, and of the scan
            steps = [np.interp(course[..., k], g, np.gradient(g)) for k, g in enumerate(grids)]
            step = np.stack([*steps, np.broadcast_to(apart[:, None, None], top.shape)], axis=-1)
            refined = course + finer * moves[:, None] * step  # (s, k, n, g)
            gains = gained(refined)
            chosen = np.argmax(gains, axis=1)[:, None]
            course = np.take_along_axis(refined, chosen[..., None], axis=1)
            gains = np.take_along_axis(gains, chosen, axis=1)
            top = np.logaddexp(top, gains + level * volume)  # a peak fills little of its cell
        np.put_along_axis(nats, best, top, axis=1)
        constant = problem.noise.log_scale(problem.data.weight) + count * problem.noise.log_norm()
        return cls(tuple(strengths), nats, rough, plain[:, 0] - constant)

    def acting(self) -> Floats:
        """Gain of each breath if the effect acts in it, at a common strength, ``(s, n)``."""
        logs = np.log(np.abs(self.strengths))
        log_prior = -0.5 * ((logs[:, None] - logs) / _SPREAD) ** 2
        log_prior = log_prior - np.logaddexp.reduce(log_prior, axis=1, keepdims=True)
        log_marginal = np.logaddexp.reduce(self.nats, axis=1) - np.log(self.nats.shape[1])
        return np.logaddexp.reduce(log_prior[:, :, None] + log_marginal, axis=1)

    def likeliest(self) -> tuple[int, float, float]:
        """The likeliest common strength, by its index, share of the breaths, and their gain."""
        share = _SHARES[:, None, None]
        total = mixture(share, self.acting()).sum(axis=2)
        best = np.unravel_index(int(np.argmax(total)), total.shape)
        return int(best[1]), float(_SHARES[best[0]]), float(total.max())

    def left_out(self) -> Floats:
        """Gain of each breath at the strength and the share that suit the others, ``(n,)``."""
        gained = mixture(_SHARES[:, None, None], self.acting()[None]).reshape(-1, len(self.rough))
        best = np.argmax(gained.sum(axis=1, keepdims=True) - gained, axis=0)
        return gained[best, np.arange(len(best))]

    def chances(self, strength: int, share: float) -> Floats:
        """Posterior probability that the effect acts in each breath, ``(n,)``."""
        acting = self.acting()[strength]
        against = mixture(share, self.rough)
        return 1.0 / (1.0 + np.exp(np.clip(against - np.log(share) - acting, -50.0, 50.0)))

    def acts(self, strength: int, share: float) -> Bools:
        """In which breaths it is likelier than not that the effect acts, ``(n,)``."""
        return self.acting()[strength] > np.maximum(np.log1p(-share) - np.log(share), self.rough)
