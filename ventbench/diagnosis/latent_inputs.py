"""Latent inputs: effects that vary in time and that no command explains.

A latent input is a Gaussian process, smooth or of one frequency, independent from breath to breath.
It acts on the pressure at the alveolus, on the flow of the supply, or on the reading of the sensor.
Its course is integrated out; only its size and its scale are fitted. Its response is linearised, so
that the marginal likelihood is that of a Gaussian. Coloured noise is such an input at the sensor,
and an input that acts in the physics has to explain more than that. Scatter of the valve's gain
between breaths is treated as an input that is one number for each breath.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Partition
from ventbench.diagnosis.linearisation import Linearisation, linearise
from ventbench.diagnosis.settings import LatentInputSettings
from ventbench.executor import parallel_map
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise, robust_noise
from ventbench.system_id.problem import Problem

#: Public names of the places where an input may act.
ALVEOLUS, SUPPLY, MEASUREMENT = "f(t) at the alveolus", "f(t) at the supply", "measurement"
PLACES = (ALVEOLUS, SUPPLY, MEASUREMENT)

#: Replicates of the Bayesian bootstrap of :func:`place_weights`, and its seed: a weight of 10 % is
#: known to half a percent, and the same recording always gets the same weights.
_REPLICATES, _SEED = 4000, 0

#: Scatter of the valve's gain between breaths, which is fitted as if it were an input.
GAIN_SCATTER = "gain of each breath"


@dataclass(frozen=True, eq=False)
class LatentInput:
    """The best input at one place.

    Attributes:
        place: where the input acts.
        periodic: whether it has one frequency; else it is smooth.
        scale: frequency in Hz if periodic, else correlation time in s.
        size: standard deviation, cmH2O, or a share of the flow or of the gain.
        noise: model of the measurement noise, estimated beside the input.
        training_log_likelihood: log-likelihood of all training breaths, nats.
        held_out_log_likelihood: log-likelihood of each held-out breath, nats, ``(n,)``.
        course: expected course in each training breath, ``(n, T)``.
    """

    place: str
    periodic: bool
    scale: float
    size: float
    noise: Noise
    training_log_likelihood: float
    held_out_log_likelihood: Floats
    course: Floats


class _Kernel(NamedTuple):
    """Kind, scale and standard deviation of a Gaussian process; see :class:`LatentInput`."""

    periodic: bool
    scale: float
    size: float


def fit_latent_inputs(
    evaluator: Evaluator, fitted: FittedModel, places: tuple[str, ...] = PLACES
) -> dict[str, LatentInput]:
    """Find the best input at each place; the training breaths choose its size and scale.

    Args:
        evaluator: evaluator of the recording.
        fitted: the model whose residuals inputs may explain, without patient effort.
        places: places to test.
    """
    problem, x = evaluator.refit_breath_parameters(fitted, evaluator.training)
    values = problem.values(x)

    def best(place: str) -> LatentInput:
        responses = input_responses(evaluator.training, values, place)
        return _fit_input(evaluator, fitted, problem, x, place, responses)

    return dict(zip(places, parallel_map(best, places), strict=True))


def place_weights(inputs: Iterable[LatentInput]) -> dict[str, float]:
    """Weight of each place where an input may act, by the held-out breaths; they add up to 1.

    Few breaths may decide between two places, and a difference of many nats is then less certain
    than it looks. The weights are therefore those of a Bayesian bootstrap of the breaths
    (pseudo-BMA+; Yao, Vehtari, Simpson and Gelman, 2018, doi:10.1214/17-BA1091).

    Args:
        inputs: the best input at each place.

    Returns:
        Weights by place, the largest first.
    """
    inputs = list(inputs)
    nats = np.stack([latent.held_out_log_likelihood for latent in inputs])  # (k, n)
    breaths = nats.shape[1]
    shares = np.random.default_rng(_SEED).dirichlet(np.ones(breaths), _REPLICATES)
    total = breaths * shares @ nats.T  # (replicates, k)
    odds = np.exp(total - total.max(axis=1, keepdims=True))
    weights = np.mean(odds / odds.sum(axis=1, keepdims=True), axis=0)
    order = np.argsort(-weights)
    return {inputs[k].place: float(weights[k]) for k in order}


def log_likelihood_without_input(evaluator: Evaluator, fitted: FittedModel) -> tuple[float, Floats]:
    """Log-likelihoods to compare those of a :class:`LatentInput` with, nats.

    Patient effort is integrated out, if the model has it.

    Returns:
        Of all training breaths, and of each held-out breath, ``(n,)``.
    """
    likelihoods = []
    for partition in (evaluator.training, evaluator.held_out):
        problem, x = evaluator.refit_breath_parameters(fitted, partition)
        linear = _linearise(evaluator, problem, x)
        gain = evaluator.breath_term(fitted).linear_gain(linear, fitted)
        likelihoods.append(_gaussian_log_likelihood(linear, fitted.noise) + gain)
    return float(likelihoods[0].sum()), likelihoods[1]


def exceeds_sensor_noise(evaluator: Evaluator, with_effort: FittedModel) -> bool:
    """Whether patient effort explains more of the held-out breaths than slow sensor noise.

    Args:
        evaluator: evaluator of the recording.
        with_effort: a model with patient effort.
    """
    hypothesis = with_effort.hypothesis
    passive = evaluator.fit(
        hypothesis.without(*hypothesis.breath_terms), with_effort.noise, with_effort
    )
    sensor = fit_latent_inputs(evaluator, passive, (MEASUREMENT,))[MEASUREMENT]
    # An input's likelihood leaves out the noise's norm, which does not depend on residuals.
    weight = evaluator.held_out.data.weight
    constant = sensor.noise.log_likelihood(np.zeros_like(weight), weight)
    constant += sensor.noise.log_scale(weight)
    ahead = evaluator.held_out_log_likelihood(with_effort) - sensor.held_out_log_likelihood
    return float((ahead - constant).sum()) > evaluator.settings.held_out_test.threshold


def input_responses(partition: Partition, values: Floats, place: str) -> Floats:
    """Change of the pressure by a unit input at one sample, cmH2O.

    Only resistance, compliance and the expiratory valve are modelled. Other mechanisms are left
    out, so that an input's course is right to about 10 %.

    Args:
        partition: n breaths of T samples.
        values: physical values of its parameters, ``(n, P + 1)``.
        place: pressure at the alveolus, cmH2O; flow of the supply, as a share of it; pressure at
            the sensor, cmH2O; or the logarithm of the valve's gain.

    Returns:
        ``(n, T, T)``, input first; for the gain ``(n, 1, T)``.
    """
    data, names = partition.data, partition.predictor.names
    n, samples = data.u_in.shape
    if place == GAIN_SCATTER:
        column = (names.index("gain"),)
        slopes = partition.predictor.derivatives(values, column)[1][:, :, 0]
        return slopes * values[:, column[0], None, None]
    if place == MEASUREMENT:
        return np.broadcast_to(np.eye(samples), (n, samples, samples)).copy()
    R, C, R_ex, gain = (values[:, names.index(name)] for name in ("R", "C", "R_ex", "gain"))
    C = C * 1e-3
    volume, responses = np.zeros((n, samples)), np.zeros((n, samples, samples))
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


def _fit_input(
    evaluator: Evaluator,
    fitted: FittedModel,
    problem: Problem,
    x: Floats,
    place: str,
    responses: Floats,
) -> LatentInput:
    """Estimate an input and the noise beside it in turn, then evaluate the held-out breaths."""
    settings, training = evaluator.settings.latent_inputs, evaluator.training
    noise, best = fitted.noise, None
    for _ in range(settings.noise_rounds):
        linear = _linearise(evaluator, replace(problem, noise=noise), x)
        gained, kernel = _best_kernel(linear, training, place, responses, settings)
        total = float(_gaussian_log_likelihood(linear, noise).sum()) + gained
        if best is not None and total < best[0] + settings.noise_gain:
            break
        best = (total, noise, kernel)
        if gained < settings.min_gain:
            break
        process = _GaussianProcess(linear, training, responses, kernel, settings)
        noise = _noise_beside(process, linear, responses, settings)
    assert best is not None
    total, noise, kernel = best
    linear = _linearise(evaluator, replace(problem, noise=noise), x)
    course = -_GaussianProcess(linear, training, responses, kernel, settings).expected()[0]
    problem, x = evaluator.refit_breath_parameters(fitted)
    linear = _linearise(evaluator, replace(problem, noise=noise), x)
    responses = input_responses(evaluator.held_out, linear.values, place)
    process = _GaussianProcess(linear, evaluator.held_out, responses, kernel, settings)
    held_out = _gaussian_log_likelihood(linear, noise) + process.gained()
    return LatentInput(
        place, kernel.periodic, kernel.scale, kernel.size, noise, total, held_out, course
    )


def _best_kernel(
    linear: Linearisation,
    partition: Partition,
    place: str,
    responses: Floats,
    settings: LatentInputSettings,
) -> tuple[float, _Kernel]:
    """The kernel of the largest likelihood, and its gain, nats."""
    relative = place in (SUPPLY, GAIN_SCATTER)
    sizes = [settings.relative_size * size if relative else size for size in settings.sizes]
    best = (-np.inf, _Kernel(False, 1.0, 1.0))
    kinds = ((True, settings.frequencies), (False, settings.correlation_times))
    for periodic, scales in ((False, (1.0,)),) if place == GAIN_SCATTER else kinds:
        for scale in scales:
            process = _GaussianProcess(
                linear, partition, responses, _Kernel(periodic, float(scale), 1.0), settings
            )
            for size in sizes:
                gained = float(process.gained(size).sum())
                best = max(best, (gained, _Kernel(periodic, float(scale), size)))
    return best


class _GaussianProcess:
    """An input's process, seen through the whitened recording."""

    def __init__(
        self,
        linear: Linearisation,
        partition: Partition,
        responses: Floats,
        kernel: _Kernel,
        settings: LatentInputSettings,
    ) -> None:
        """Factorise the covariance of unit size; ``responses`` as of :func:`input_responses`."""
        self._size = kernel.size
        dt = partition.data.dt
        time = np.cumsum(dt, axis=1) - dt
        if responses.shape[1] == 1:  # one number for each breath
            self._root = np.ones((len(time), 1, 1))
        elif kernel.periodic:
            angle = 2.0 * np.pi * kernel.scale * time
            self._root = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (n, 2, K)
        else:
            # Breaths of about equal intervals share a root; jitter is far below the scale.
            interval = np.round(dt.mean(axis=1), 4)
            steps, which = np.unique(interval, return_inverse=True)
            lag = np.subtract.outer(*[np.arange(time.shape[1])] * 2)[None] * steps[:, None, None]
            values, vectors = np.linalg.eigh(np.exp(-0.5 * (lag / kernel.scale) ** 2))
            kept = int(np.max(np.sum(values > settings.min_variance, axis=1)))
            scaled = vectors[:, :, -kept:] * np.sqrt(np.maximum(values[:, None, -kept:], 0.0))
            self._root = scaled.swapaxes(1, 2)[which.reshape(-1)]
        rows = np.matmul(self._root, responses)[:, :, None, :]
        rows = linear.without_own(linear.whiten(rows))
        self._power, self._axes = np.linalg.eigh(np.matmul(rows, rows.swapaxes(1, 2)))
        self._power = np.maximum(self._power, 0.0)
        force = np.matmul(rows, linear.residual[:, :, None])[:, :, 0]
        self._force = np.einsum("nij,ni->nj", self._axes, force)

    def gained(self, size: float | None = None) -> Floats:
        """Log-likelihood that an input of a size gains in each breath, nats, ``(n,)``."""
        size = self._size if size is None else size
        grown = 1.0 + size**2 * self._power
        return 0.5 * np.sum(size**2 * self._force**2 / grown - np.log(grown), axis=1)

    def expected(self) -> tuple[Floats, Floats]:
        """Posterior mean of minus the input, ``(n, K)``, and its degrees of freedom, ``(n,)``."""
        size = self._size
        grown = 1.0 + size**2 * self._power
        weights = np.einsum("nij,nj->ni", self._axes, size**2 * self._force / grown)
        course = np.einsum("ni,nik->nk", weights, self._root)
        return course, np.sum(1.0 - 1.0 / grown, axis=1)


def _noise_beside(
    process: _GaussianProcess,
    linear: Linearisation,
    responses: Floats,
    settings: LatentInputSettings,
) -> Noise:
    """Noise that is left once the expected input is taken out."""
    course, freedom = process.expected()
    data = linear.problem.data
    residual = (linear.prediction - data.measured) * data.weight
    residual[:, 0] -= np.einsum("nk,nkt->nt", course, responses) * data.weight[:, 0]
    noise = robust_noise(residual, data.weight)
    share = 1.0 - float(freedom.sum()) / float(data.weight[:, 0].sum())
    sigma = noise.sigma[0] / np.sqrt(max(share, settings.min_noise_share))
    return replace(noise, sigma=(sigma, *noise.sigma[1:]))


def _gaussian_log_likelihood(linear: Linearisation, noise: Noise) -> Floats:
    """Log-likelihood of each breath without any input, up to the noise's norm, ``(n,)``."""
    return -0.5 * np.sum(linear.residual**2, axis=1) - noise.log_scale(linear.problem.data.weight)


def _linearise(evaluator: Evaluator, problem: Problem, x: Floats) -> Linearisation:
    settings = evaluator.settings
    return linearise(problem, x, settings.screening, clip=settings.latent_inputs.clip)
