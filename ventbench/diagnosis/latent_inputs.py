"""Latent inputs: effects that vary in time and that no command explains.

A latent input is a Gaussian process, smooth or of one frequency, independent from breath to breath.
It acts on the pressure at the alveolus, on the flow of the supply, on the reading of the sensor, or
swings in the circuit while gas flows.
Its course is integrated out; its size, its scale and the noise beside it are those that make the
recording likeliest (:mod:`ventbench.diagnosis.gaussian_process`). Coloured noise is such an input
at the sensor, and an input that acts in the physics has to explain more than that. Scatter of the
valve's gain between breaths is treated as an input that is one number for each breath.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import optimize

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.gaussian_process import (
    Kernel,
    LinearBreaths,
    components,
    likeliest_beside,
    uses,
)
from ventbench.diagnosis.hypothesis import FittedModel, Partition
from ventbench.physics.events import HALF_SWING
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import LEAST_SIGMA, MOST_AR, Noise

#: Public names of the places where an input may act.
ALVEOLUS, SUPPLY, MEASUREMENT = "f(t) at the alveolus", "f(t) at the supply", "measurement"
CIRCUIT = "f(t) in the circuit"
PLACES = (ALVEOLUS, SUPPLY, MEASUREMENT, CIRCUIT)

#: Replicates of the Bayesian bootstrap of :func:`place_weights`, and its seed: a weight of 10 % is
#: known to half a percent, and the same recording always gets the same weights.
_REPLICATES, _SEED = 4000, 0

#: Limits of the coordinates of :func:`_noise_point`.
_NOISE_LIMITS = (
    (np.log(LEAST_SIGMA), np.log(100.0)),
    (-np.arctanh(MOST_AR), np.arctanh(MOST_AR)),
)

#: First steps of a climb: in these coordinates, and in the logarithms of size and frequency.
_STEPS = (0.2, 0.2, 0.2, 0.02)

#: Accuracy of all these coordinates and of the log-likelihood, nats, at the end of a climb.
_TOLERANCE, _NATS = 0.01, 0.2

#: How far a climb may move the logarithm of a frequency: to the next one of the grid.
_FREQUENCY_SPAN = 0.1

#: Grids: frequencies of periodic inputs, Hz, from heart beats to the pulsation of a supply;
#: correlation times of smooth ones, s; standard deviations, cmH2O. Those of a flow or of a valve's
#: gain are shares, of :data:`RELATIVE_SIZE` 1/cmH2O.
_FREQUENCIES = (*np.arange(0.6, 2.0, 0.1), *np.arange(2.0, 9.1, 0.25))
_CORRELATION_TIMES = (0.08, 0.12, 0.2, 0.3, 0.5, 0.8, 1.2)
_SIZES = np.array([0.1, 0.2, 0.4, 0.8, 1.6, 3.2])
RELATIVE_SIZE = 0.1

#: Most times that the parameters beside an input, its kernel, and its size and noise are found in
#: turn, and log-likelihood, nats, that another round must gain.
_ROUNDS, _GAIN = 3, 1.0

#: Correlation of neighbouring samples from which a climb also starts from white noise.
_COLOURED = 0.2

#: Components of a unit covariance with less variance are left out.
_MIN_VARIANCE = 1e-2

#: Size of an input, as a share of that it starts from, below which it is none.
_LEAST_SIZE = 0.1

#: Scatter of the valve's gain between breaths, which is fitted as if it were an input.
GAIN_SCATTER = "gain of each breath"


@dataclass(frozen=True, eq=False)
class LatentInput:
    """The best input at one place."""

    place: str  #: where the input acts.
    periodic: bool  #: whether it has one frequency; else it is smooth.
    scale: float  #: frequency in Hz if periodic, else correlation time in s.
    size: float  #: standard deviation, cmH2O, or a share of the flow or of the gain.
    #: the model whose residuals it explains, with the parameters and the noise that are the
    #: likeliest beside it.
    beside: FittedModel
    training_log_likelihood: float  #: log-likelihood of all training breaths, nats.
    held_out_log_likelihood: Floats  #: log-likelihood of each held-out breath, nats, ``(n,)``.
    course: Floats  #: expected course in each training breath, ``(n, T)``.
    scale_sd: float = float("nan")  #: standard deviation of a frequency, Hz; NaN if smooth.

    @property
    def noise(self) -> Noise:
        """Model of the measurement noise beside the input."""
        return self.beside.noise


def fit_latent_inputs(
    evaluator: Evaluator, fitted: FittedModel, places: tuple[str, ...] = PLACES
) -> dict[str, LatentInput]:
    """Find the best input at each place; the training breaths choose its size, scale and noise.

    Args:
        evaluator: evaluator of the recording.
        fitted: the model whose residuals inputs may explain, without patient effort.
        places: places to test.
    """
    model, dt = at_best_noise(evaluator, fitted), evaluator.training.data.dt
    linear, every = _Linear.of(model), () if places == (GAIN_SCATTER,) else _kernels()
    parts = {kernel: components(dt, kernel, _MIN_VARIANCE) for kernel in every}

    def best(place: str) -> LatentInput:
        return _fit_input(evaluator, linear, place, parts)

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

    They are those of the model at the noise that is likeliest without an input. Patient effort is
    integrated out, if the model has it.

    Returns:
        Of all training breaths, and of each held-out breath, ``(n,)``.
    """
    model = at_best_noise(evaluator, fitted)
    training = float(evaluator.log_likelihood(model, evaluator.training).sum())
    return training, evaluator.held_out_log_likelihood(model)


def at_best_noise(evaluator: Evaluator, fitted: FittedModel) -> FittedModel:
    """A model with the noise of the pressure that makes the training breaths likeliest.

    Other noises are estimated by robust moments, which do not climb the likelihood. Compared with
    an input whose noise does, they would credit the input with the difference.

    Args:
        evaluator: evaluator of the recording.
        fitted: a model of the training breaths.
    """
    settings = evaluator.settings
    for _ in range(settings.fit.noise_rounds):
        before = evaluator.training_log_likelihood(fitted)

        def fall(point: Floats, fitted: FittedModel = fitted) -> float:
            return -evaluator.training_log_likelihood(fitted, _noise_at(fitted.noise, point))

        start = _noise_point(fitted.noise)
        noise = _noise_at(fitted.noise, _climb(fall, start, _NOISE_LIMITS))
        climbed = evaluator.training_log_likelihood(fitted, noise)
        fitted = _updated(fitted, fitted.minimum.x, noise)
        if climbed < before + settings.fit.noise_gain:
            break
        problem, x = fitted.problem, fitted.minimum.x
        refitted = _updated(
            fitted, likeliest_beside(problem, x, LinearBreaths.of(problem, x)), noise
        )
        if evaluator.training_log_likelihood(refitted) < climbed:
            break
        fitted = refitted
    return fitted


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
    if sensor.size > evaluator.settings.latent_inputs.sensor_noise:
        return True  # no sensor is that noisy, and an input can be all that is missing
    by_effort = log_likelihood_without_input(evaluator, with_effort)[1]
    ahead = float((by_effort - sensor.held_out_log_likelihood).sum())
    return ahead > evaluator.settings.held_out_test.threshold


def input_responses(partition: Partition, values: Floats, place: str) -> Floats:
    """Change of the pressure by a unit input at one sample, cmH2O.

    Only resistance, compliance and the expiratory valve are modelled. Other mechanisms are left
    out, so that an input's course is right to about 10 %.

    Args:
        partition: n breaths of T samples.
        values: physical values of its parameters, ``(n, P + 1)``.
        place: pressure at the alveolus, cmH2O; flow of the supply, as a share of it; pressure at
            the sensor, cmH2O, and in the circuit at a large flow; or the logarithm of the valve's
            gain.

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


@dataclass(frozen=True, eq=False)
class _Process:
    """A process at a place, as it acts on the training breaths."""

    kernel: Kernel  #: kind and scale.
    components: Floats  #: its components, ``(n, K, T)``.
    responses: Floats  #: change of the pressure by each of them, cmH2O, ``(n, K, 1, T)``.

    @classmethod
    def of(cls, kernel: Kernel, parts: Floats, responses: Floats) -> _Process:
        """A process by its components and the ``responses`` of :func:`input_responses`."""
        return cls(kernel, parts, np.matmul(parts, responses)[:, :, None])


@dataclass(frozen=True, eq=False)
class _Linear:
    """A model of the training breaths to first order."""

    model: FittedModel  #: the model.
    breaths: LinearBreaths  #: its breaths, with all parameters.
    own: LinearBreaths  #: its breaths with the parameters that differ from breath to breath.

    @classmethod
    def of(cls, model: FittedModel) -> _Linear:
        breaths = LinearBreaths.of(model.problem, model.minimum.x)
        return cls(model, breaths, breaths.only((uses(model.problem) == 1).all(axis=0)))


class _Fit(NamedTuple):
    """A process with its size and the noise beside it."""

    nats: float  #: log marginal likelihood of the training breaths.
    process: _Process  #: the process.
    size: float  #: its standard deviation.
    noise: Noise  #: model of the measurement noise.
    coefficients: Floats | None  #: see :class:`~ventbench.diagnosis.gaussian_process.Marginal`.
    scale_sd: float = float("nan")  #: see :class:`LatentInput`.


def _fit_input(
    evaluator: Evaluator, linear: _Linear, place: str, parts: dict[Kernel, Floats]
) -> LatentInput:
    """Climb the training likelihood of an input at one place, then evaluate the held-out breaths.

    The best kernel at one noise is climbed in size and noise. Beside that input, other parameters
    of the model may be better, and then another kernel, and so on until nothing gains.

    Args:
        evaluator: evaluator of the recording.
        linear: the model whose residuals the input may explain.
        place: where it acts.
        parts: components of the kernels that are compared.
    """
    training = evaluator.training
    if place == GAIN_SCATTER:
        parts = {Kernel(False, 1.0): np.ones((len(training.data), 1, 1))}
    if place == CIRCUIT:  # water swings; anything else there is a leak or another resistance
        parts = {kernel: each for kernel, each in parts.items() if kernel.periodic}

    def climbed(linear: _Linear, noise: Noise, known: _Fit | None = None) -> _Fit:
        responses = input_responses(training, linear.model.values, place)
        processes = [_Process.of(kernel, each, responses) for kernel, each in parts.items()]
        if known is not None:
            process = _Process.of(known.process.kernel, known.process.components, responses)
            known = known._replace(process=process)
        first = _best_kernel(linear.own, processes, noise, _unit(place), known)
        return _climb_process(linear.own, first, responses, training.data.dt)

    model = linear.model
    starts = (climbed(linear, noise) for noise in _first_noises(model.noise))
    best = max(starts, key=lambda fit: fit.nats)
    least = float(linear.own.whitened(model.noise).marginal(1.0).nats.sum()) + _GAIN
    for _ in range(_ROUNDS if best.nats > least else 0):
        problem, x = replace(linear.model.problem, noise=best.noise), linear.model.minimum.x
        x = likeliest_beside(problem, x, linear.breaths, best.process.responses, best.size)
        linear = _Linear.of(_updated(linear.model, x, best.noise))
        trial = climbed(linear, best.noise, best)
        if trial.nats < best.nats + _GAIN:
            break
        best, model = trial, linear.model
    model = _updated(model, model.minimum.x, best.noise)
    kernel, count = best.process.kernel, best.process.responses.shape[1]
    assert best.coefficients is not None
    course = np.einsum("nk,nkt->nt", best.coefficients[:, :count], best.process.components)
    problem, x = evaluator.refit_breath_parameters(model)
    responses = input_responses(evaluator.held_out, problem.values(x), place)
    each = np.ones((len(responses), 1, 1))
    if place != GAIN_SCATTER:
        each = components(problem.data.dt, kernel, _MIN_VARIANCE)
    process = _Process.of(kernel, each, responses)
    whitened = LinearBreaths.of(problem, x).whitened(best.noise, process.responses)
    return LatentInput(
        place, kernel.periodic, kernel.scale, best.size, model, best.nats,
        whitened.marginal(best.size).nats, course, best.scale_sd,
    )  # fmt: skip


def _updated(model: FittedModel, x: Floats, noise: Noise) -> FittedModel:
    """A model at other unknowns ``(U,)`` and another noise."""
    problem = replace(model.problem, noise=noise)
    minimum = replace(model.minimum, x=x, cost=problem.cost(x))
    likelihood = float(problem.log_likelihood(x).sum())
    return FittedModel(model.hypothesis, problem, minimum, likelihood)


def _first_noises(noise: Noise) -> list[Noise]:
    """Noises that a climb starts from: the given one, and white noise if it is coloured.

    Coloured noise excuses slow errors, and beside it a slow input may be at a lower maximum.
    """
    ar = noise.ar[0]
    if abs(ar) < _COLOURED:
        return [noise]
    sigma = (noise.sigma[0] * float(np.sqrt(1.0 - ar**2)), *noise.sigma[1:])
    return [noise, replace(noise, sigma=sigma, ar=(0.0, *noise.ar[1:]))]


def _kernels() -> list[Kernel]:
    """Kinds and scales that are compared."""
    kernels = [Kernel(True, float(scale)) for scale in _FREQUENCIES]
    return kernels + [Kernel(False, float(scale)) for scale in _CORRELATION_TIMES]


def _best_kernel(
    breaths: LinearBreaths,
    processes: list[_Process],
    noise: Noise,
    unit: float,
    known: _Fit | None,
) -> _Fit:
    """The process and the size of the largest likelihood at one noise.

    Samples have the weights that they have beside the input that is known, if there is one. Sizes
    are multiples of ``unit``.
    """
    sizes = _SIZES * unit
    if known is None:
        whitened, size = breaths.whitened(noise), 1.0
    else:
        sizes, size, processes = (
            np.append(sizes, known.size),
            known.size,
            [known.process, *processes],
        )
        whitened = breaths.whitened(noise, known.process.responses)
    left = whitened.left(whitened.marginal(size).coefficients)
    best = None
    for process in processes:
        bounds = breaths.whitened(noise, process.responses).bounds(sizes, left)
        top = int(np.argmax(bounds))
        if best is None or bounds[top] > best.nats:
            best = _Fit(float(bounds[top]), process, float(sizes[top]), noise, None)
    assert best is not None
    return best


def _climb_process(breaths: LinearBreaths, first: _Fit, responses: Floats, dt: Floats) -> _Fit:
    """Maximise the likelihood by the size of an input, its frequency and the noise beside it.

    Correlation times stay on their grid: each has components of its own, which cost as much as the
    rest of a climb.
    """
    best, kernel = first._replace(nats=-np.inf), first.process.kernel

    def fall(point: Floats) -> float:
        nonlocal best
        noise, size, process = _noise_at(first.noise, point), float(np.exp(point[2])), first.process
        if kernel.periodic:
            moved = kernel._replace(scale=float(np.exp(point[3])))
            parts = components(dt, moved, _MIN_VARIANCE)
            process = _Process.of(moved, parts, responses)
        marginal = breaths.whitened(noise, process.responses).marginal(size, best.coefficients)
        nats = float(marginal.nats.sum())
        if nats > best.nats:
            best = _Fit(nats, process, size, noise, marginal.coefficients)
        return -nats

    start = [*_noise_point(first.noise), np.log(first.size)]
    limits = [*_NOISE_LIMITS, (start[2] + np.log(_LEAST_SIZE), start[2] - np.log(_LEAST_SIZE))]
    if kernel.periodic:
        start.append(np.log(kernel.scale))
        limits.append((start[3] - _FREQUENCY_SPAN, start[3] + _FREQUENCY_SPAN))
    _climb(fall, np.array(start), limits)
    if not kernel.periodic:
        return best
    top = best
    frequency = top.process.kernel.scale
    point = np.array([*_noise_point(top.noise), np.log(top.size), np.log(frequency)])
    move = np.array([0.0, 0.0, 0.0, _STEPS[3]])
    lost = fall(point - move) + fall(point + move) + 2.0 * top.nats  # a parabola's
    sd = frequency * _STEPS[3] / np.sqrt(max(lost, 1e-9))
    return best._replace(scale_sd=float(sd))


def _climb(
    fall: Callable[[Floats], float], start: Floats, limits: Sequence[tuple[float, float]]
) -> Floats:
    """Where a function of the coordinates of a climb is least, near a start (Nelder and Mead)."""
    low, high = np.transpose(limits)
    start = np.clip(start, low, high)
    steps = np.array(_STEPS[: len(start)])
    steps = np.where(start + steps > high, -steps, steps)
    return optimize.minimize(
        fall, start, method="Nelder-Mead", bounds=list(limits),
        options={
            "initial_simplex": np.vstack([start, start + np.diag(steps)]),
            "xatol": _TOLERANCE,
            "fatol": _NATS,
        },
    ).x  # fmt: skip


def _noise_point(noise: Noise) -> Floats:
    """Coordinates of the pressure's noise: log sigma, and the inverse tanh of its correlation."""
    return np.array([np.log(noise.sigma[0]), np.arctanh(noise.ar[0])])


def _noise_at(noise: Noise, point: Floats) -> Noise:
    """The noise at other coordinates."""
    sigma, ar = float(np.exp(point[0])), float(np.tanh(point[1]))
    return replace(noise, sigma=(sigma, *noise.sigma[1:]), ar=(ar, *noise.ar[1:]))


def _unit(place: str) -> float:
    """Factor from sizes in cmH2O to those of a place."""
    return RELATIVE_SIZE if place in (SUPPLY, GAIN_SCATTER) else 1.0
