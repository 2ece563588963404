"""A sensor behind a simulator: what its readings lack, whatever the simulator is inside.

A learned simulator errs by what no mechanism describes, and a description that errs by as much as a
missing sensor's lag does cannot find the lag. What lies behind a simulator's answers needs no
description: each mechanism of the sensor acts on these pressures themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats
from ventbench.diagnosis.estimates import with_form_error
from ventbench.diagnosis.findings import MissingMechanism
from ventbench.diagnosis.settings import SelectionConfig
from ventbench.diagnosis.unknown import preference
from ventbench.diagnosis.validation import explained_share, passes_heldout_test
from ventbench.mechanics.labels import Estimate
from ventbench.physics.catalogue import library, mechanism
from ventbench.physics.mechanism import Parameter
from ventbench.plants.sensed import Sensor, readings, sensor
from ventbench.system_id.data import Data, Noise, robust_noise

#: Least weight of another mechanism that is listed as an alternative.
_LISTED = 0.05


@dataclass(frozen=True, eq=False)
class SensorBehind:
    """Mechanisms of a sensor behind a simulator."""

    sensor: Sensor  #: the sensor.
    name: str  #: its mechanism.
    parameters: dict[str, Estimate]  #: by short name.
    #: posterior probability among mechanisms of the sensor, none, and what else explains the
    #: recording, by testing breaths.
    confidence: float
    alternatives: tuple[str, ...]  #: other mechanisms, the likeliest first.
    nats: float  #: log-likelihood that testing breaths gain.
    worth: float  #: root-mean-square error that it takes from testing breaths, cmH2O.
    error: float  #: root-mean-square error of testing breaths with it, cmH2O.

    def readings(self, pressure: Floats, dt: Floats) -> Floats:
        """What it shows of pressures, cmH2O, ``(n, T)``; NaN of breaths that are not simulated."""
        with compilation.float64():
            shown = np.asarray(readings(self.sensor, np.nan_to_num(pressure), dt))
        return np.where(np.isfinite(pressure), shown, np.nan)

    def missing(self, errors: tuple[float, float]) -> MissingMechanism:
        """As a finding.

        Args:
            errors: error beside it, and what is shown to be no noise of that, cmH2O.
        """
        return MissingMechanism(
            self.name,
            with_form_error(self.parameters, self.name),
            self.confidence,
            self.alternatives,
            self.nats,
            worth=self.worth,
            explains=explained_share(self.worth, *errors),
        )


class _Fit(NamedTuple):
    """A mechanism fitted to the training breaths."""

    name: str
    values: Floats  #: of its parameters.
    error: Floats  #: of all breaths, simulated less measured, cmH2O, ``(n, T)``.
    slopes: Floats  #: changes of the errors of the training breaths, ``(n, T, k)``.


def find_sensor(
    data: Data,
    held: Bools,
    fitted: Bools,
    response: Floats,
    rivals: Sequence[Floats],
    settings: SelectionConfig,
) -> SensorBehind | None:
    """The mechanism of a sensor that explains most, if testing breaths ask for it; else None.

    It must also err less on them than the simulator as given, and than what explains them
    otherwise: the recording's own model, or the simulator with another lung.

    Args:
        data: n recorded breaths of T samples.
        held: which of them test, ``(n,)``.
        fitted: which the final fit may use, ``(n,)``.
        response: pressures of the simulator for the recorded commands, cmH2O, ``(n, T)``.
        rivals: what else explains the pressures, cmH2O, ``(n, T)`` each.
        settings: every threshold.
    """
    names = [name for name in library() if _acts_behind(name)]
    weight, response = data.weight[:, :1], np.nan_to_num(response)
    given = response - data.measured[:, 0]
    fits = [_fit(name, data, ~held, response) for name in names]
    best = min(fits, key=lambda fit: _square(fit.error, weight, ~held))
    noise = robust_noise(best.error[~held][:, None], weight[~held])
    bound = noise.tail * noise.sigma[0]

    def log_likelihood(error: Floats, which: Bools) -> Floats:
        return noise.log_likelihood(error[which][:, None], weight[which])

    gains = log_likelihood(best.error, held) - log_likelihood(given, held)
    if not passes_heldout_test(gains, settings.held_out_test):
        return None
    # Each against the best, tempered as the posterior of a search is.
    likeliest = float(log_likelihood(best.error, held).sum())

    def odds_of(error: Floats) -> float:
        return 1.0 / preference(likeliest - float(log_likelihood(error, held).sum())) - 1.0

    odds = {fit.name: odds_of(fit.error) for fit in fits if fit is not best}
    listed = sorted((n for n in odds if odds[n] > _LISTED), key=lambda n: -odds[n])
    others = [given, *(rival - data.measured[:, 0] for rival in rivals)]
    error = float(np.sqrt(_square(best.error, weight, held)))
    least = min(_square(other, weight, held) for other in others)
    if error >= settings.simulator.residual_model_share * np.sqrt(least):
        return None
    final = _fit(best.name, data, fitted, response)
    paths = [f"{best.name}.{p.name}" for p in mechanism(best.name).description.parameters]
    return SensorBehind(
        sensor(dict(zip(paths, final.values, strict=True))),
        best.name,
        _estimates(final, np.clip(final.error[fitted], -bound, bound)),
        1.0 / (1.0 + sum(odds.values()) + sum(map(odds_of, others))),
        tuple(listed),
        float(gains.sum()),
        float(np.sqrt(_square(given, weight, held))) - error,
        error,
    )


def _acts_behind(name: str) -> bool:
    """Whether a mechanism acts on readings alone, in all breaths alike."""
    effect = mechanism(name)
    acts = effect.has("reading") or effect.has("sensor_output")
    return acts and effect.description.site == "sensor" and not effect.uses_position


def _fit(name: str, data: Data, training: Bools, response: Floats) -> _Fit:
    """The least error on the training breaths, robust as :class:`Noise` is, from several starts."""
    from scipy.optimize import least_squares  # here, as it takes long to import

    parameters = mechanism(name).description.parameters
    low, high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
    weight, measured = data.weight[:, 0], data.measured[:, 0]
    scale = 1.4826 * float(np.median(np.abs(response - measured)[weight > 0.0])) + 1e-6

    def error(values: Floats, which: Bools) -> Floats:
        at = sensor({f"{name}.{p.name}": x for p, x in zip(parameters, values, strict=True)})
        with compilation.float64():
            shown = np.asarray(readings(at, response[which], data.dt[which]))
        return np.where(weight[which] > 0.0, shown - measured[which], 0.0)

    def starts(parameter: Parameter) -> tuple[float, ...]:
        if parameter is parameters[0]:
            return (parameter.mild, parameter.strong)
        return parameter.grid or (parameter.neutral,)

    results = [
        least_squares(
            lambda values: error(values, training).ravel() / scale,
            np.clip(start, low, high),
            bounds=(low, high),
            x_scale=high - low,
            loss="huber",
            f_scale=Noise().tail,
        )
        for start in product(*map(starts, parameters))
    ]
    best = min(results, key=lambda result: float(result.cost))
    every = np.ones(len(data), bool)
    slopes = scale * best.jac.reshape(int(training.sum()), -1, len(parameters))
    return _Fit(name, best.x, error(best.x, every), slopes)


def _square(error: Floats, weight: Floats, which: Bools) -> float:
    """Mean square of an error over the readings of some breaths, cmH2O^2."""
    chosen = weight[which, 0] > 0.0
    return float(np.mean(error[which][chosen] ** 2))


def _estimates(fit: _Fit, error: Floats) -> dict[str, Estimate]:
    """Estimates with 95 % intervals that allow for what the errors of a breath share (sandwich).

    A parameter at a bound is taken as given.

    Args:
        fit: the fitted mechanism.
        error: of the training breaths, bounded as the fit bounds them, cmH2O, ``(n, T)``.
    """
    parameters = mechanism(fit.name).description.parameters
    low, high = (np.array([getattr(p, end) for p in parameters]) for end in ("low", "high"))
    inside = np.flatnonzero(np.minimum(fit.values - low, high - fit.values) > 1e-6 * (high - low))
    slopes, breaths = fit.slopes[:, :, inside], len(fit.slopes)
    bread = np.linalg.pinv(np.einsum("ntj,ntk->jk", slopes, slopes))
    scores = np.einsum("ntk,nt->nk", slopes, error)
    spread = np.sqrt(np.diag(bread @ (scores.T @ scores) @ bread) * breaths / (breaths - 1))
    wide = stdtrit(breaths - 1, 0.975) * spread
    estimates = {}
    for k, half in zip(inside, wide, strict=True):
        p, x = parameters[k], float(fit.values[k])
        ends = (max(x - float(half), p.low), min(x + float(half), p.high))
        estimates[p.name] = Estimate(x, p.unit, ends)
    return estimates
