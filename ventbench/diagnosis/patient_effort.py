"""Patient effort: the one mechanism whose parameters differ from breath to breath.

Each breath has an effort of its own amplitude and onset, so that the likelihood at the best values
proves nothing. Both are integrated out: the amplitude is Gaussian, the onset uniform, and a breath
has no effort at all with some probability. Where efforts are weak, sums over a grid of onsets are
exact to first order. Where they are strong, an onset that is late by a tenth of a second is off by
more than the noise, and no small step of a fit mends an effort that is put where there is none:
each breath's effort is then started where the breath is likeliest, fitted, and integrated out
around the fit (Laplace's method).

The rest of the diagnosis does not know about efforts: it treats hypotheses with and without them
alike, through :class:`BreathTerm`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ventbench.base.linear import solve
from ventbench.diagnosis.hypothesis import FittedModel, Linearisation, linearise
from ventbench.system_id.data import Floats
from ventbench.system_id.levenberg_marquardt import Minimum, minimise
from ventbench.system_id.predictor import START, Predictor
from ventbench.system_id.problem import Problem, make_unknowns

EFFORT = "patient_effort"
AMPLITUDE, ONSET, DURATION = (f"{EFFORT}.{p}" for p in ("amplitude", "onset", "duration"))

#: Prior of efforts: standard deviation of the amplitude, cmH2O; grid of onsets after the breath's
#: start, s; length of time in which efforts begin, s, the grid and one step; share of the breaths
#: that have one.
AMPLITUDE_SD, ONSETS = 3.0, np.array([0.1 * k for k in range(17)])
_SPAN, PROBABILITY = ONSETS[-1] - ONSETS[0] + 0.1, 0.6

#: 1 / variance of amplitude, 1 / cmH2O^2, and of a uniform onset, 1 / s^2.
_PRECISION = (AMPLITUDE_SD**-2.0, 12.0 / _SPAN**2)

#: Amplitude at which an effort's effect is simulated, cmH2O.
_TEMPLATE = 1.0

#: Nats by which another effort of a breath must be better to be moved to; and where the fit of each
#: breath's effort ends: expected fall of the cost, nats, and steps.
_RESTART_GAIN, _TOLERANCE, _STEPS = 1.0, 0.2, 7


class BreathTerm:
    """The part of a hypothesis that differs from breath to breath; here there is none."""

    def start(
        self, problem: Problem, x: Floats, fitted_names: Iterable[str], *, refit: bool
    ) -> Floats:
        """Move each breath's own parameters to where the breath is likelier, ``(U,)``.

        Args:
            problem: problem of the hypothesis.
            x: point in the coordinates of its unknowns.
            fitted_names: terms of the model that the unknowns come from.
            refit: fit what is tried to each breath before it is compared, as ``x`` is.
        """
        return x

    def marginal_log_likelihood(self, fitted: FittedModel) -> Floats:
        """Log-likelihood of the breaths of a fit, ``(n,)``."""
        return fitted.noise.log_likelihood(fitted.residual, fitted.problem.data.weight)

    def log_likelihood_gain(self, problem: Problem, x: Floats, fitted: FittedModel) -> Floats:
        """Log-likelihood that the term gains in breaths that no fit has seen, ``(n,)``.

        Args:
            problem: problem of these breaths, without the term.
            x: point in the coordinates of its unknowns, which differ from breath to breath.
            fitted: the model, fitted to other breaths.
        """
        return np.zeros(len(problem.data))

    def predict(self, fitted: FittedModel, predictor: Predictor, values: Floats) -> Floats:
        """Expected readings of breaths to come, ``(n, c, T)``, at values ``(n, P + 1)``."""
        return predictor.predict(values)

    def spread(self, fitted: FittedModel, predictor: Predictor, values: Floats) -> Floats:
        """Standard deviation of these, as nobody knows what a breath to come has of its own."""
        return np.zeros((1, 1, 1))


def breath_term(names: Iterable[str]) -> BreathTerm:
    """The breath term of a hypothesis with the terms ``names``."""
    return PatientEffortTerm() if EFFORT in tuple(names) else BreathTerm()


class _Evidence(NamedTuple):
    """Log Bayes factor of an effort in each breath, and the likeliest effort."""

    nats: Floats  #: ``(n,)``.
    amplitude: Floats  #: cmH2O, expected at the likeliest onset, ``(n,)``.
    onset: Floats  #: s, the likeliest, ``(n,)``.


class PatientEffortTerm(BreathTerm):
    """Efforts of a patient, integrated out in each breath."""

    def start(
        self, problem: Problem, x: Floats, fitted_names: Iterable[str], *, refit: bool
    ) -> Floats:
        """Move each breath's effort to where the breath is clearly likelier."""
        if EFFORT in fitted_names and not refit:
            return x
        layout, names = problem.unknowns, problem.predictor.names
        values = problem.values(x)
        duration = float(values[0, names.index(DURATION)])
        passive = values.copy()
        passive[:, names.index(AMPLITUDE)] = 0.0
        unknowns, none = make_unknowns(problem.data, (START,)), np.zeros(len(values))
        passive_problem = replace(
            problem, unknowns=unknowns, fixed=passive, mean=none, precision=none
        )
        at = unknowns.pack({START: values[:, -1]})
        evidence = self._evidence(linearise(passive_problem, at, clip=np.inf), duration)
        effort = {AMPLITUDE: evidence.amplitude, ONSET: evidence.onset}
        if refit:
            breathwise, minimum = self._fit_breathwise(passive_problem, at, evidence)
            effort = {p: minimum.x[breathwise.unknowns.of(p)] for p in (*effort, START)}
        trial = x.copy()
        columns = [layout.index[:, layout.paths.index(path)] for path in effort]
        for column, value in zip(columns, effort.values(), strict=True):
            trial[column] = value
        trial = np.clip(trial, *layout.bounds())
        least = problem.log_likelihood(x) + _RESTART_GAIN
        likelier = problem.log_likelihood(trial) > least
        for column in columns:
            trial[column] = np.where(likelier, trial[column], x[column])
        return trial

    def log_likelihood_gain(self, problem: Problem, x: Floats, fitted: FittedModel) -> Floats:
        """Integrate efforts out of breaths without any, at the fitted duration, ``(n,)``."""
        duration = float(fitted.column(DURATION)[0])
        start = self._evidence(linearise(problem, x), duration)
        breathwise, minimum = self._fit_breathwise(problem, x, start)
        curvature = minimum.hessian[
            breathwise.unknowns.index[:, :, None], breathwise.unknowns.index[:, None, :]
        ]
        amplitude = minimum.x[breathwise.unknowns.of(AMPLITUDE)]
        with_effort = breathwise.log_likelihood(minimum.x) + self._log_volume(curvature, amplitude)
        gained = with_effort - problem.log_likelihood(x)
        laplace = np.logaddexp(np.log(1.0 - PROBABILITY), np.log(PROBABILITY) + gained)
        # A weak effort's onset is free, as on the grid; for a strong one that is too coarse.
        return np.maximum(start.nats, laplace)

    def marginal_log_likelihood(self, fitted: FittedModel) -> Floats:
        """Integrate efforts out around the efforts that the fit found, ``(n,)``."""
        problem, noise = fitted.problem, fitted.noise
        layout, data = problem.unknowns, problem.data
        every = range(len(layout.paths))
        breathwise = [k for k in every if len(np.unique(layout.index[:, k])) == len(data)]
        breathwise = [k for k in breathwise if layout.paths[k] not in (AMPLITUDE, ONSET)]
        columns = [*breathwise, layout.paths.index(AMPLITUDE), layout.paths.index(ONSET)]
        residual, slopes = fitted.jacobian
        white = noise.whiten(residual, data.weight).reshape(len(data), -1)
        rows = noise.whiten(slopes[:, columns], data.weight)
        rows = rows.reshape(*rows.shape[:2], -1)
        curvature = np.matmul(rows * noise.influence(white)[:, None], rows.swapaxes(1, 2))
        index = layout.index[:, columns]
        prior = np.concatenate([problem.precision[index[:, :-2]], np.zeros((len(data), 2))], axis=1)
        prior[:, -2:] = _PRECISION
        curvature = curvature + prior[:, :, None] * np.eye(len(columns))
        active = noise.log_likelihood(residual, data.weight)
        active = active + self._log_volume(curvature, fitted.column(AMPLITUDE))
        passive = noise.log_likelihood(fitted.residual_excluding(EFFORT), data.weight)
        return np.logaddexp(np.log(1.0 - PROBABILITY) + passive, np.log(PROBABILITY) + active)

    def predict(self, fitted: FittedModel, predictor: Predictor, values: Floats) -> Floats:
        """Mean over the efforts of the fitted breaths: nobody knows the effort of a new breath."""
        return self._moments(fitted, predictor, values)[0]

    def spread(self, fitted: FittedModel, predictor: Predictor, values: Floats) -> Floats:
        """Standard deviation over the efforts of the fitted breaths."""
        mean, square = self._moments(fitted, predictor, values)
        return np.sqrt(np.maximum(square - mean**2, 0.0))

    def _moments(
        self, fitted: FittedModel, predictor: Predictor, values: Floats
    ) -> tuple[Floats, Floats]:
        columns = [predictor.names.index(path) for path in (AMPLITUDE, ONSET)]
        mean, square = 0.0, 0.0
        count = len(fitted.column(AMPLITUDE))
        for effort in zip(fitted.column(AMPLITUDE), fitted.column(ONSET), strict=True):
            values[:, columns] = effort
            pressure = predictor.predict(values)
            mean, square = mean + pressure / count, square + pressure**2 / count
        return np.asarray(mean), np.asarray(square)

    def _evidence(self, linear: Linearisation, duration: float) -> _Evidence:
        """Integrate efforts of a duration, s, out of a model's breaths on the grid of onsets."""
        predictor, logs, means = linear.problem.predictor, [], []
        columns = [predictor.names.index(path) for path in (AMPLITUDE, ONSET, DURATION)]
        points = np.repeat(linear.values[None], len(ONSETS), axis=0)
        for point, onset in zip(points, ONSETS, strict=True):
            point[:, columns] = (_TEMPLATE, onset, duration)
        precision = (_TEMPLATE / AMPLITUDE_SD) ** 2
        for effect in predictor.predict_all(points) - linear.prediction:
            white = linear.whiten(effect)
            template = linear.project_out_breath(white[:, None])[:, 0]
            power = np.sum(template**2, axis=1)
            match = -np.sum(linear.residual * template, axis=1)
            logs.append(0.5 * match**2 / (power + precision) - 0.5 * np.log1p(power / precision))
            means.append(match / (power + precision) * _TEMPLATE)
        log_factors, amplitudes = np.stack(logs, 1), np.stack(means, 1)
        mixed = np.logaddexp.reduce(log_factors, axis=1)
        mixed = mixed - np.log(len(ONSETS)) + np.log(PROBABILITY)
        top = np.argmax(log_factors, axis=1)
        nats = np.logaddexp(np.log(1.0 - PROBABILITY), mixed)
        return _Evidence(nats, amplitudes[np.arange(len(top)), top], ONSETS[top])

    def _fit_breathwise(
        self, passive_problem: Problem, x: Floats, start: _Evidence
    ) -> tuple[Problem, Minimum]:
        """Fit an effort to each breath, together with the breath's other own parameters."""
        paths, none = passive_problem.unknowns.paths, np.zeros(len(passive_problem.data))
        every = np.arange(len(none))
        layout = make_unknowns(
            passive_problem.data, (*paths, AMPLITUDE, ONSET), dict.fromkeys(paths, every)
        )
        problem = replace(
            passive_problem,
            unknowns=layout,
            mean=np.concatenate([passive_problem.mean, none, none + np.mean(ONSETS)]),
            precision=np.concatenate(
                [passive_problem.precision, none + _PRECISION[0], none + _PRECISION[1]]
            ),
        )
        first = dict(zip(paths, passive_problem.unknowns.unpack(x).T, strict=True))
        first |= {AMPLITUDE: start.amplitude, ONSET: start.onset}
        low, high = layout.bounds()
        return problem, minimise(
            problem.cost,
            problem.normal,
            layout.pack(first),
            low,
            high,
            tolerance=_TOLERANCE,
            iterations=_STEPS,
        )

    def _log_volume(self, curvature: Floats, amplitude: Floats) -> Floats:
        """Logarithm of prior density times posterior volume around the best effort, ``(n,)``.

        Args:
            curvature: curvature by each breath's own unknowns, amplitude and onset last, with the
                prior's precision, ``(n, k, k)``.
            amplitude: the best, cmH2O, ``(n,)``.
        """
        across, nuisance = curvature[:, -2:, :-2], curvature[:, :-2, :-2]
        inner = curvature[:, -2:, -2:] - across @ solve(nuisance, across.swapaxes(1, 2))
        norm = np.sqrt(2.0 * np.pi) * AMPLITUDE_SD * _SPAN
        prior = -0.5 * (amplitude / AMPLITUDE_SD) ** 2 - np.log(norm)
        return np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(inner)[1] + prior
