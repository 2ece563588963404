"""Evidence for efforts of the patient, which differ from breath to breath.

Amplitude and onset are each breath's own, so that a likelihood at their best values proves nothing.
They are integrated out: amplitude is Gaussian, onset one of a grid, and a breath may have none.

Efforts of the patient fitted to each breath, and what they make of its likelihood.

A strong effort that is taken to begin a tenth of a second late is off by more than the noise, and
no small step of a fit mends one that is put where there is none. Each breath's effort is therefore
started where the breath is likeliest, and integrated out around where it ends (Laplace's method).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ventbench.diagnosis.hypothesis import FittedModel
from ventbench.diagnosis.linearisation import CLIP, Linearisation, linearise
from ventbench.system_id.data import Floats
from ventbench.system_id.derivatives import START
from ventbench.system_id.least_squares import Minimum, minimise
from ventbench.system_id.noise import Noise
from ventbench.system_id.problem import Problem
from ventbench.system_id.unknowns import unknowns

EFFORT = "patient_effort"

#: Onsets, s, durations, s, amplitude of a template and its prior standard deviation, cmH2O, and
#: the share of breaths that have an effort.
ONSETS = tuple(0.1 * k for k in range(0, 17))
_DURATIONS = (0.4, 0.6, 0.8, 1.0, 1.3)
_AMPLITUDE, WIDTH, SHARE = 1.0, 3.0, 0.6


class Evidence(NamedTuple):
    """Log Bayes factor of efforts in each breath, and the likeliest effort.

    Attributes:
        nats: ``(n,)``.
        duration: s, that of the largest sum.
        amplitude: cmH2O, expected at the likeliest onset, ``(n,)``.
        onset: s, the likeliest, ``(n,)``.
    """

    nats: Floats
    duration: float
    amplitude: Floats
    onset: Floats


def evidence(place: Linearisation, duration: float | None = None) -> Evidence:
    """Integrate efforts out of the breaths of a linearised hypothesis.

    Args:
        place: of the breaths.
        duration: of the efforts, s; the best of a grid if not given.
    """
    return of_all([place], duration)[0]


def of_all(places: list[Linearisation], duration: float | None = None) -> list[Evidence]:
    """The same of one hypothesis at several noises, which share what is predicted."""
    best: list[Evidence] = []
    for length in _DURATIONS if duration is None else (duration,):
        found = _at(places, length)
        best = best or found
        best = [new if new.nats.sum() > old.nats.sum() else old
                for new, old in zip(found, best, strict=True)]  # fmt: skip
    return best


def _at(places: list[Linearisation], duration: float) -> list[Evidence]:
    answers = _answers(places[0], duration)
    return [_of(place, duration, answers) for place in places]


def _answers(place: Linearisation, duration: float) -> list[Floats]:
    """What an effort at each onset changes, ``(n, c, T)``."""
    simulator = place.problem.simulator
    columns = [simulator.names.index(f"{EFFORT}.{p}") for p in ("amplitude", "onset", "duration")]
    points = np.repeat(place.values[None], len(ONSETS), axis=0)
    for point, onset in zip(points, ONSETS, strict=True):
        point[:, columns] = (_AMPLITUDE, onset, duration)
    return list(simulator.predict_all(points) - place.seen)


def _of(place: Linearisation, duration: float, answers: list[Floats]) -> Evidence:
    logs, means = [], []
    for answer in answers:
        white = place.whitened(answer)
        template = place.without_own(white[:, None])[:, 0]
        power = np.sum(template**2, axis=1)
        match = -np.sum(place.residual * template, axis=1)
        precision = (_AMPLITUDE / WIDTH) ** 2
        logs.append(0.5 * match**2 / (power + precision) - 0.5 * np.log1p(power / precision))
        means.append(match / (power + precision) * _AMPLITUDE)
    log_factors, amplitudes = np.stack(logs, 1), np.stack(means, 1)
    mixed = np.logaddexp.reduce(log_factors, axis=1) - np.log(len(ONSETS)) + np.log(SHARE)
    top = np.argmax(log_factors, axis=1)
    nats = np.logaddexp(np.log(1.0 - SHARE), mixed)
    rows = np.arange(len(top))
    return Evidence(nats, duration, amplitudes[rows, top], np.asarray(ONSETS)[top])


AMPLITUDE, ONSET, DURATION = (f"{EFFORT}.{p}" for p in ("amplitude", "onset", "duration"))

#: Nats by which another effort must be likelier to be moved to.
_CLEARLY = 1.0

#: Length of time in which efforts begin, s; most steps of a fit to each breath.
_SPAN, _STEPS = ONSETS[-1] - ONSETS[0] + 0.1, 7

#: 1 / variance of amplitudes and onsets before any data, 1 / cmH2O2 and 1 / s2.
_KNOWN = (WIDTH**-2.0, 12.0 / _SPAN**2)


def restart_efforts(problem: Problem, x: Floats, *, refined: bool) -> Floats:
    """Move each breath's effort to where it is likelier, if it clearly is.

    Args:
        problem: of a hypothesis with efforts.
        x: its unknowns, ``(U,)``.
        refined: fit what is tried to each breath before it is compared, as ``x`` is.
    """
    layout, names = problem.unknowns, problem.simulator.names
    values = problem.values(x)
    duration = float(values[0, names.index(DURATION)])
    quiet = values.copy()
    quiet[:, names.index(AMPLITUDE)] = 0.0
    own, none = unknowns(problem.data, (START,)), np.zeros(len(values))
    still = replace(problem, unknowns=own, fixed=quiet, mean=none, precision=none)
    at = own.pack({START: values[:, -1]})
    found = of_all([linearise(still, at, np.inf)], duration)[0]
    tried = {AMPLITUDE: found.amplitude, ONSET: found.onset}
    if refined:
        each, fitted = _fitted(still, at, found)
        tried = {path: fitted.x[each.unknowns.of(path)] for path in (*tried, START)}
    trial = x.copy()
    places = [layout.index[:, layout.paths.index(path)] for path in tried]
    for place, value in zip(places, tried.values(), strict=True):
        trial[place] = value
    trial = np.clip(trial, *layout.bounds())
    likelier = problem.log_likelihood(trial) > problem.log_likelihood(x) + _CLEARLY
    for place in places:
        trial[place] = np.where(likelier, trial[place], x[place])
    return trial


def effort_log_likelihood_gain(still: Problem, x: Floats, duration: float) -> Floats:
    """Log-likelihood that efforts gain in each breath, where there is one or none, ``(n,)``.

    Args:
        still: without efforts; its unknowns are each breath's own.
        x: these.
        duration: of the efforts, s.
    """
    grid, start = of_all([linearise(still, x, CLIP), linearise(still, x, np.inf)], duration)
    gained = _around(*_fitted(still, x, start)) - still.log_likelihood(x)
    pulled = np.logaddexp(np.log(1.0 - SHARE), np.log(SHARE) + gained)
    # A weak effort's onset is free, as on the grid; for a strong one that is too coarse.
    return np.maximum(grid.nats, pulled)


def marginal_log_likelihood(fitted: FittedModel, noise: Noise) -> Floats:
    """Log-likelihood of the breaths that efforts were fitted to, efforts integrated out, ``(n,)``.

    As :func:`effort_log_likelihood_gain`, around the efforts that the fit found.

    Args:
        fitted: a hypothesis with efforts.
        noise: at which it is judged.
    """
    problem = replace(fitted.problem, noise=noise)
    layout, data = problem.unknowns, problem.data
    own = [k for k in range(len(layout.paths)) if len(np.unique(layout.index[:, k])) == len(data)]
    own = [k for k in own if layout.paths[k] not in (AMPLITUDE, ONSET)]
    columns = [*own, layout.paths.index(AMPLITUDE), layout.paths.index(ONSET)]
    residual, slopes = fitted.jacobian
    white = noise.whiten(residual, data.weight).reshape(len(data), -1)
    rows = noise.whiten(slopes[:, columns], data.weight)
    rows = rows.reshape(*rows.shape[:2], -1)
    curvature = np.matmul(rows * noise.influence(white)[:, None], rows.swapaxes(1, 2))
    index = layout.index[:, columns]
    known = np.concatenate([problem.precision[index[:, :-2]], np.zeros((len(data), 2))], axis=1)
    known[:, -2:] = _KNOWN
    curvature = curvature + known[:, :, None] * np.eye(len(columns))
    loud = noise.log_likelihood(residual, data.weight)
    loud = loud + _volume(curvature, fitted.column(AMPLITUDE))
    quiet = noise.log_likelihood(fitted.residual_without(EFFORT), data.weight)
    return np.logaddexp(np.log(1.0 - SHARE) + quiet, np.log(SHARE) + loud)


def _fitted(still: Problem, x: Floats, start: Evidence) -> tuple[Problem, Minimum]:
    """Fit an effort to each breath, with what else is the breath's own."""
    paths, none = still.unknowns.paths, np.zeros(len(still.data))
    every = np.arange(len(none))
    layout = unknowns(still.data, (*paths, AMPLITUDE, ONSET), dict.fromkeys(paths, every))
    problem = replace(
        still,
        unknowns=layout,
        mean=np.concatenate([still.mean, none, none + np.mean(ONSETS)]),
        precision=np.concatenate([still.precision, none + _KNOWN[0], none + _KNOWN[1]]),
    )
    known = dict(zip(paths, still.unknowns.unpack(x).T, strict=True))
    known |= {AMPLITUDE: start.amplitude, ONSET: start.onset}
    low, high = layout.bounds()
    return problem, minimise(
        problem.cost, problem.normal, layout.pack(known), low, high, tolerance=0.2,
        iterations=_STEPS,
    )  # fmt: skip


def _around(problem: Problem, found: Minimum) -> Floats:
    """Likelihood of each breath with an effort, integrated around its best one, ``(n,)``."""
    layout = problem.unknowns
    curvature = found.hessian[layout.index[:, :, None], layout.index[:, None, :]]
    amplitude = found.x[layout.of(AMPLITUDE)]
    return problem.log_likelihood(found.x) + _volume(curvature, amplitude)


def _volume(curvature: Floats, amplitude: Floats) -> Floats:
    """Logarithm of prior density times volume of efforts around the best one, ``(n,)``.

    Args:
        curvature: by each breath's own unknowns, the efforts' amplitude and onset the last, with
            what is known before, ``(n, k, k)``.
        amplitude: the best, cmH2O, ``(n,)``.
    """
    across, own = curvature[:, -2:, :-2], curvature[:, :-2, :-2]
    inner = curvature[:, -2:, -2:] - across @ np.linalg.solve(own, across.swapaxes(1, 2))
    prior = -0.5 * (amplitude / WIDTH) ** 2 - np.log(np.sqrt(2.0 * np.pi) * WIDTH * _SPAN)
    return np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(inner)[1] + prior
