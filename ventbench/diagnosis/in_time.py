"""What acts in time as terms of a linearised experiment: in some breaths, or as a swing.

A breath is affected or not, and the share of affected breaths is uniform: the likeliest set of
breaths is found by flips. A swing has one frequency and in each breath a size and phase of its own.

Affected breaths are exchangeable given their commands: a breath whose commands ask for much flow is
no likelier to meet a cough. With the posterior probability ``r_b`` that breath ``b`` is affected,
``E[r_b | commands] = share`` for every breath, as the mean of a posterior is its prior, however
much the commands let a breath tell. What commands predict is physics that the model lacks. A swing
has a phase of its own in each breath, so that its expected coefficients have the mean zero,
whatever the commands: one whose sign the breath or its commands predict is no swing.

Commands may be lost, which leaves the valve at the one before, or come late by ``lag`` samples, and
then act only if none that was sent after them has arrived. At each sample the valve thus either
follows or keeps what it has, and readings up to the next sample depend on no later command: a
search from sample to sample that keeps the likeliest paths (a beam) has their exact likelihoods.
The sum over the paths that are kept is a lower bound of the likelihood with all of them. A command
is lost whatever it asks for: where those that the valve did not follow ask for less of a move than
the others, the valve sticks, or has play, and nothing was lost. (They may ask for more, as small
ones are lost without a trace.)
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from ventbench.base.arrays import Floats
from ventbench.diagnosis.hypothesis import FittedModel, Partition
from ventbench.diagnosis.linearised import CONSTANT, EFFORT, OPEN, LinearModel, Term, gaussian
from ventbench.diagnosis.settings import SelectionConfig
from ventbench.physics.events import HALF_SWING
from ventbench.system_id.data import Data
from ventbench.system_id.problem import Problem

#: Public names of the places where an input may act.
ALVEOLUS, SUPPLY, CIRCUIT = "f(t) at the alveolus", "f(t) at the supply", "f(t) in the circuit"

#: Pushes of the muscles: sign, size, cmH2O, durations and onsets, s; and shares of the size that
#: harmonics have, as forms are unsure.
_PUSHES = {
    "cough": (1.0, 8.0, (0.15, 0.22, 0.3), np.arange(0.1, 1.9, 0.1)),
    EFFORT: (-1.0, 3.0, (0.5, 0.8, 1.1), np.arange(0.0, 1.0, 0.1)),
}
_HARMONICS = (1.0, 0.5, 0.25)

#: Oscillations: place, frequencies, Hz, harmonics, and standard deviations of coefficients.
SWINGS = {
    "supply_ripple": (SUPPLY, np.arange(1.5, 9.1, 0.25), 1, (0.06, 0.15)),
    "circuit_water": (CIRCUIT, np.arange(1.5, 9.1, 0.25), 1, (0.5, 1.2)),
    "unknown:muscles": (ALVEOLUS, np.arange(0.7, 2.6, 0.1), 2, (0.4, 1.0)),
}

#: Samples by which commands may be late; share of them that is tried first.
_COMMANDS, _FIRST_SHARE = {"lost_commands": (None,), "late_commands": (2, 3, 4)}, 0.1

#: Permutations of breaths, and p-value from which commands do not predict which are affected.
_PERMUTATIONS, EXCHANGEABLE = 2000, 0.01

#: Share by which the course of an input is off, as only the lung and the valves are modelled.
INPUT_ERROR = 0.1

#: Paths that are kept in each breath, and difference of commands, %, that is none.
_PATHS, _SAME = 6, 0.3


def _share(n: float, k: float) -> float:
    """Log prior of k affected breaths, or commands, of n, whose share is uniform."""
    return float(special.betaln(k + 1, n - k + 1))


def _affected(G: Floats, b: Floats, sd: float, cost: float) -> tuple[Any, Floats]:
    """Breaths in which an effect acts, by flips that gain, and how likely it acts in each.

    Args:
        G: products of a column of each breath, ``(n, n)``.
        b: their products with the residual, ``(n,)``.
        sd: standard deviation of a size, which is positive.
        cost: of each affected breath, nats.
    """
    n = len(b)

    def value(acts: Any) -> float:
        at = np.flatnonzero(acts)
        if not len(at):
            return _share(n, 0)
        gained, mean, _ = gaussian(G[np.ix_(at, at)], b[at], np.full(len(at), sd))
        return gained + _share(n, len(at)) - cost * len(at) - 1e3 * float(np.sum(mean < 0.0))

    optima: list[tuple[float, Any, Floats]] = []
    mean = gaussian(G, b, np.full(n, sd))[1]
    for acts in (np.zeros(n, bool), mean > 0.3 * max(float(mean.max()), 0.0)):
        reached, moves = value(acts), True
        while moves:
            flips = np.array([value(acts ^ (np.arange(n) == i)) for i in range(n)])
            moves = bool(flips.max() > reached)
            if moves:
                acts, reached = acts ^ (np.arange(n) == int(np.argmax(flips))), float(flips.max())
        optima.append(
            (reached, acts, special.expit(np.where(acts, reached - flips, flips - reached)))
        )
    _, acts, likely = max(optima, key=lambda optimum: optimum[0])
    return np.flatnonzero(acts), likely


def _commands_of(data: Data, pressure: Floats) -> Floats:
    """Ranks of what commands ask of each breath, centred, of unit length, ``(k, n)``.

    Peak opening, volume, highest predicted pressure, and the lung's R and C.
    """
    inspiratory = (data.u_out == 0) * data.u_in
    volume = np.sum(inspiratory * data.dt, axis=1)
    series = (inspiratory.max(axis=1), volume, pressure.max(axis=1), data.R, data.C)
    ranks = np.stack([np.unique(values, return_inverse=True)[1] for values in series])
    ranks = ranks - ranks.mean(axis=1, keepdims=True)
    return ranks / np.maximum(np.linalg.norm(ranks, axis=1, keepdims=True), 1e-12)


def command_p_value(affected: Floats, data: Data, pressure: Floats) -> float:
    """Probability that breaths in random order depend as much on their commands.

    Args:
        affected: posterior probability that each breath is affected, ``(n,)``.
        data: the breaths.
        pressure: what a model without the effect predicts, cmH2O, ``(n, T)``.
    """
    rng = np.random.default_rng(0)
    permuted = rng.permuted(np.tile(affected, (_PERMUTATIONS, 1)), axis=1)
    permuted = np.concatenate([affected[None], permuted])
    largest = np.abs(permuted @ _commands_of(data, pressure).T).max(axis=1)
    return float(np.mean(largest >= largest[0] * (1.0 - 1e-9)))


def phase_p_value(sizes: Floats, data: Data, pressure: Floats) -> float:
    """Probability that swings of random phases depend as much on the breath or its commands.

    Args:
        sizes: expected coefficients of each breath's sines and cosines, ``(n, m)``.
        data: the breaths.
        pressure: what a model without the effect predicts, cmH2O, ``(n, T)``.
    """
    series = np.concatenate(
        [np.full((1, len(sizes)), len(sizes) ** -0.5), _commands_of(data, pressure)]
    )
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_PERMUTATIONS + 1, len(sizes)))
    signs[0] = 1.0
    norm = np.linalg.norm(sizes, axis=0)
    projected = np.einsum(
        "pn,kn,nm->pkm", signs, series, sizes / np.maximum(norm, 1e-12), optimize=True
    )
    largest = np.abs(projected).max(axis=(1, 2))
    return float(np.mean(largest >= largest[0] * (1.0 - 1e-9)))


def in_time(
    model: LinearModel,
    partition: Partition,
    around: FittedModel,
    excluded: Collection[str],
    settings: SelectionConfig,
) -> list[Term]:
    """Terms that act in time.

    Args:
        model: the breaths, linearised around the base model.
        partition: the same breaths.
        around: the base model.
        excluded: effects that cannot act.
        settings: every threshold.
    """
    terms = of_some_breaths(model, partition, excluded, settings)
    unpenalised = swings(model, partition, [name for name in SWINGS if name not in excluded])
    if "lost_commands" not in excluded:
        unpenalised += _commands(model, partition, around)
    return [*terms, *(with_course(term, settings) for term in unpenalised)]


def swings(model: LinearModel, partition: Partition, names: Collection[str]) -> list[Term]:
    """Swings, each at its likeliest frequency and size, but for those that commands predict."""
    terms = []
    for name in names:
        place, frequencies, harmonics, spreads = SWINGS[name]
        by_input = input_responses(partition, model.around.values, place)
        candidates = [
            (np.matmul(_waves(partition, f, harmonics), by_input), float(f), spread)
            for f, spread in product(frequencies, spreads)
        ]
        term, sizes = _likeliest_swing(model, name, candidates)
        if phase_p_value(sizes, partition.data, _predicted(model)) > EXCHANGEABLE:
            terms.append(term)
    return terms


def _predicted(model: LinearModel) -> Floats:
    """Pressure without what acts in time, cmH2O, ``(n, T)``."""
    return (model.fitted.residual + model.fitted.problem.data.measured)[:, 0]


def with_course(term: Term, settings: SelectionConfig) -> Term:
    """The term, less likely by the courses in time that it was chosen of."""
    return replace(term, odds=term.odds - settings.search.course_nats)


def of_some_breaths(
    model: LinearModel, partition: Partition, excluded: Collection[str], settings: SelectionConfig
) -> list[Term]:
    """Events, each with the likeliest course in each breath and the likeliest breaths.

    Events whose breaths commands predict are left out.
    """
    n, data, terms = model.n, partition.data, []
    predicted = _predicted(model)
    time = np.cumsum(data.dt, axis=1) - data.dt
    sizes = {name: size for name, (_, size) in CONSTANT.items()} | {OPEN: 1.0}
    every = {(name, sizes[name]): model.around.events[name][None] for name in model.around.events}
    pushes = {name: pulse for name, pulse in _PUSHES.items() if name not in excluded}
    push = input_responses(partition, model.around.values, ALVEOLUS)
    for name, (sign, size, durations, onsets) in pushes.items():
        x = np.clip([(time - a) / d for a, d in product(onsets, durations)], 0.0, 1.0)
        shape = [sign * np.sin(np.pi * h * x) for h in range(1, len(_HARMONICS) + 1)]
        every[name, size] = np.matmul(np.stack(shape)[:, :, :, None], push)[:, :, :, 0]
    for (name, size), responses in every.items():  # the first, and deviations of its form
        gains = []
        for course in responses[0]:
            power, b = model.breath_diagonal(course)
            curvature = power + size**-2.0
            gains.append(0.5 * np.maximum(b, 0.0) ** 2 / curvature - 0.5 * np.log(curvature))
        chosen = responses[:, np.argmax(gains, axis=0), np.arange(n)]
        cost = float(np.log(responses.shape[1]))
        at, likely = _affected(*model.of_breaths(chosen[0, :, None]), size, cost)
        if len(at) and command_p_value(likely, data, predicted) > EXCHANGEABLE:
            which = (at[:, None] == np.arange(n))[:, :, None]
            columns = [column for form in chosen for column in np.where(which, form, 0.0)]
            spread = [size * h for h in _HARMONICS[: len(chosen)] for _ in at]
            odds = _share(n, len(at)) - cost * len(at)
            terms.append(with_course(Term(name, spread, odds=odds, latent=columns), settings))
    return terms


def swing_columns(
    name: str, partition: Partition, values: Floats, frequency: float
) -> tuple[Floats, Floats]:
    """Sines and cosines of a swing, as pressures and as they act, ``(n, 2 harmonics, T)`` each.

    Args:
        name: the swing, of :data:`SWINGS`.
        partition: n breaths.
        values: physical values of their parameters, ``(n, P + 1)``.
        frequency: Hz.
    """
    place, _, harmonics, _ = SWINGS[name]
    courses = _waves(partition, frequency, harmonics)
    return np.matmul(courses, input_responses(partition, values, place)), courses


def swing_spreads(count: int, spread: float) -> Floats:
    """Standard deviations of the coefficients of a swing: a second harmonic is half the first.

    Else half of a frequency explains as much as the frequency.
    """
    spreads = spread / np.arange(1, count // 2 + 1)
    return np.concatenate([spreads, spreads])


def _waves(partition: Partition, frequency: float, harmonics: int) -> Floats:
    time = np.cumsum(partition.data.dt, axis=1) - partition.data.dt
    angle = 2.0 * np.pi * frequency * np.arange(1, harmonics + 1)[:, None] * time[:, None]
    return np.concatenate([np.sin(angle), np.cos(angle)], axis=1)


def _likeliest_swing(
    model: LinearModel, name: str, candidates: list[tuple[Floats, float, float]]
) -> tuple[Term, Floats]:
    """The frequency and size of the largest evidence, and coefficients of each breath, (n, m)."""
    best, at, coefficients = -np.inf, candidates[0], np.zeros((model.n, 0))
    for candidate in candidates:
        G, b = model.of_breaths(candidate[0])
        spreads = np.tile(swing_spreads(candidate[0].shape[1], candidate[2]), model.n)
        value, mean, _ = gaussian(G, b, spreads)
        if value > best:
            best, at, coefficients = value, candidate, mean.reshape(model.n, -1)
    columns_at, frequency, spread = at
    which = np.eye(model.n, dtype=bool)[:, :, None]
    sizes = range(columns_at.shape[1])
    columns = [column for m in sizes for column in np.where(which, columns_at[:, m], 0.0)]
    swing = {"frequency": frequency, "spread": spread}
    odds = -float(np.log(len(candidates)))
    spreads = np.repeat(swing_spreads(columns_at.shape[1], spread), model.n).tolist()
    return Term(name, spreads, odds=odds, latent=columns, swing=swing), coefficients


def _commands(model: LinearModel, partition: Partition, around: FittedModel) -> list[Term]:
    """Lost and late commands."""
    data, values, terms = partition.data, model.around.values, []
    problem, x = replace(around.problem, noise=model.noise), around.minimum.x
    for name, lags in _COMMANDS.items():
        share = _FIRST_SHARE
        for _ in range(2):  # a share that is too large takes noise for losses
            candidates = [follow(problem, x, partition, share, lag) for lag in lags]
            nats = np.array([paths.nats.sum() for paths in candidates])
            best = candidates[int(np.argmax(nats))]
            missed, sent = float(best.missed.sum()), float(best.sent.sum())
            sent = max(sent, missed)  # a valve that waits counts at every sample
            share = (missed + 1.0) / (sent + 2.0)
        if not missed or ask_for_little(best, data.u_in) <= EXCHANGEABLE:
            break
        reached = partition.predictor.of(replace(data, u_in=best.u_in))
        column = reached.predict(values)[:, 0] - partition.predictor.predict(values)[:, 0]
        delay = np.logaddexp.reduce(nats - nats.max()) - np.log(len(lags))  # whatever it is
        odds = _share(sent, missed) + float(delay)
        terms.append(Term(name, [1.0], odds=odds, latent=[column]))
    return terms


def ask_for_little(paths: Paths, u_in: Floats) -> float:
    """Probability that commands which are lost at random ask for as little of a move (rank sum).

    Args:
        paths: what reached the valve.
        u_in: commands that were sent, %, ``(n, T)``.
    """
    valve = np.pad(paths.u_in[:, :-1], ((0, 0), (1, 0)))
    demand, lost = np.abs(u_in - valve), paths.u_in != u_in
    new = demand > _SAME
    new[:, -1] = False  # nobody sees what it does
    demand, lost = demand[new], lost[new]
    ranks = np.unique(demand, return_inverse=True)[1]
    ranks = ranks - ranks.mean()
    n, k = len(lost), int(lost.sum())
    sd = np.sqrt(k * (n - k) * np.mean(ranks**2) / max(n - 1, 1))
    return float(special.ndtr(ranks[lost].sum() / max(sd, 1e-12)))


def input_responses(partition: Partition, values: Floats, place: str) -> Floats:
    """Change of the pressure by a unit input at one sample that no command explains, cmH2O.

    Only resistance, compliance and the expiratory valve are modelled. Other mechanisms are left
    out, so that an input's course is right to :data:`INPUT_ERROR`.

    Args:
        partition: n breaths of T samples.
        values: physical values of its parameters, ``(n, P + 1)``.
        place: pressure at the alveolus, cmH2O; flow of the supply, as a share of it; or pressure
            in the circuit at a large flow, cmH2O.

    Returns:
        ``(n, T, T)``, input first.
    """
    data, names = partition.data, partition.predictor.names
    n, samples = data.u_in.shape
    R, C, R_ex, gain = (values[:, names.index(name)] for name in ("R", "C", "R_ex", "gain"))
    C = C * 1e-3
    volume, responses = np.zeros((n, samples)), np.zeros((n, samples, samples))
    if place == CIRCUIT:
        above = values[:, -1] - values[:, names.index("PEEP")]  # pressure in the lung
        for k in range(1, samples):
            expiratory, dt = data.u_out[:, k - 1] > 0, data.dt[:, k - 1]
            above = np.where(expiratory, above * np.exp(-dt / ((R + R_ex) * C)), above)
            inwards = gain * 1e-3 * data.u_in[:, k - 1]
            flow = np.abs(np.where(expiratory, above / (R + R_ex), inwards))
            above = np.where(expiratory, above, above + inwards * dt / C)
            responses[:, k, k] = flow / (flow + HALF_SWING)
        return responses
    for k in range(1, samples):
        expiratory = data.u_out[:, k - 1] > 0
        decay = np.where(expiratory, np.exp(-data.dt[:, k - 1] / ((R + R_ex) * C)), 1.0)
        share = np.where(expiratory, R_ex / (R + R_ex), 1.0)
        volume = volume * decay[:, None]
        direct = 0.0 * R
        if place == ALVEOLUS:
            direct = direct + 1.0
            volume[:, k] -= np.where(expiratory, (1.0 - decay) * C, 0.0)
        else:
            flow = gain * 1e-3 * data.u_in[:, k - 1]
            direct = R * flow
            filled = np.where(expiratory, (1.0 - decay) * C * R_ex, data.dt[:, k - 1])
            volume[:, k] += filled * flow
        responses[:, :, k] = share[:, None] * volume / C[:, None]
        responses[:, k, k] += share * direct
    return responses


def command_responses(partition: Partition, values: Floats) -> Floats:
    """Change of each reading by 1 % more of each command, cmH2O, ``(n, T, T)``, command first.

    Args:
        partition: n breaths of T samples.
        values: physical values of its parameters, ``(n, P + 1)``.
    """
    unit = replace(partition.data, u_in=np.ones_like(partition.data.u_in))
    by_supply = input_responses(replace(partition, data=unit), values, SUPPLY)
    return np.pad(by_supply[:, 1:], ((0, 0), (0, 1), (0, 0)))  # a command is read one sample later


class Paths(NamedTuple):
    """What lost or late commands do for n breaths."""

    nats: Floats  #: log-likelihood with them, ``(n,)``.
    u_in: Floats  #: commands on the likeliest path, %, ``(n, T)``.
    missed: Floats  #: at how many samples the valve did not follow a new command, ``(n,)``.
    sent: Floats  #: how many new commands there were, ``(n,)``.


def follow(
    problem: Problem, x: Floats, partition: Partition, share: float, lag: int | None
) -> Paths:
    """Find the commands that reached the valve.

    Args:
        problem: problem of the breaths with the commands that were sent.
        x: its unknowns, ``(U,)``.
        partition: the breaths.
        share: share of the commands that are lost or late.
        lag: samples by which a command is late; None if it is lost.
    """
    data, noise = partition.data, problem.noise
    n, samples = data.u_in.shape
    by_command = command_responses(partition, problem.values(x))
    white = noise.whiten(by_command[:, :, None], data.weight)[:, :, 0]
    first = noise.whiten(problem.residual(x), data.weight)
    residuals = np.repeat(first, _PATHS, axis=1)  # (n, b, T)
    score = np.full((n, _PATHS), -np.inf)
    score[:, 0] = 0.0
    path, held = np.zeros((n, _PATHS, samples)), np.zeros((n, _PATHS), int)
    rows = np.arange(n)[:, None]
    missed = np.zeros((n, _PATHS))
    for k in range(samples - 1):
        sent = data.u_in[:, k, None]
        valve = path[:, :, k - 1] if k else np.zeros((n, _PATHS))
        if lag is not None and k >= lag:  # the late one arrives, as none has overtaken it
            valve = np.where(held >= lag, data.u_in[:, k - lag, None], valve)
        new = np.abs(valve - sent) > _SAME
        deviation = np.concatenate([np.zeros_like(valve), valve - sent], axis=1)
        prior = np.concatenate(
            [np.where(new, np.log1p(-share), 0.0), np.where(new, np.log(share), -np.inf)], axis=1
        )
        both = (
            np.concatenate([residuals, residuals], axis=1)[:, :, k + 1]
            + deviation * white[:, k, None, k + 1]
        )
        total = np.concatenate([score, score], axis=1) + prior - noise.loss(both)
        best = np.argsort(-total, axis=1)[:, :_PATHS]
        parent, deviation = best % _PATHS, np.take_along_axis(deviation, best, axis=1)
        stays = best >= _PATHS
        score = np.take_along_axis(total, best, axis=1)
        residuals = residuals[rows, parent] + deviation[:, :, None] * white[:, k, None]
        path, missed = path[rows, parent], missed[rows, parent] + stays
        path[:, :, k] = sent + deviation
        held = np.where(stays, held[rows, parent] + 1, 0)
    path[:, :, -1] = data.u_in[:, -1:]
    changes = np.abs(np.diff(data.u_in[:, :-1], axis=1, prepend=0.0)) > _SAME
    constant = noise.log_scale(data.weight) + data.weight.sum(axis=(1, 2)) * noise.log_norm()
    nats = np.logaddexp.reduce(score, axis=1) - noise.loss(first[:, 0, 0]) - constant
    return Paths(nats, path[:, 0], missed[:, 0], changes.sum(axis=1))
