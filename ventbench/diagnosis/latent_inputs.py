"""What a source that moves in time would do to the recorded pressure, to first order.

Evidence for sources that move in time, in each breath in its own way.

A source is a Gaussian process, smooth or of one frequency, independent from breath to breath, and
is integrated out: only its size and scale are fitted. Coloured noise is such a source at the
sensor, and so has to be beaten by one that sits in the physics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Partition
from ventbench.diagnosis.linearisation import Linearisation, linearise
from ventbench.diagnosis.patient_effort import EFFORT, evidence
from ventbench.diagnosis.settings import GATE
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise, estimate
from ventbench.system_id.problem import Problem
from ventbench.system_id.together import each

#: Public names of the slots whose shape is a function of time, of each breath its own.
ALVEOLUS, SUPPLY, MEASUREMENT = "f(t) at the alveolus", "f(t) at the supply", "measurement"
LATENT_INPUTS = (ALVEOLUS, SUPPLY, MEASUREMENT)

#: Not a place but a scatter: each breath has its own valve gain.
GAIN = "gain of each breath"


def input_responses(partition: Partition, values: Floats, source: str) -> Floats:
    """Pressures that answer to a unit source at one sample, ``(n, T, T)``: source, then pressure.

    Of a gain, ``(n, 1, T)``, to its logarithm.

    Resistance and compliance as fitted, all else left out: a source is drawn to about 10 %.

    Args:
        partition: n breaths of T samples.
        values: physical values of its parameters, ``(n, P + 1)``.
        source: pressure at the alveolus, cmH2O; flow of the inspiratory valve, as a share of it; or
            pressure at the sensor, cmH2O.
    """
    data, names = partition.data, partition.simulator.names
    n, samples = data.u_in.shape
    if source == GAIN:
        column = (partition.simulator.names.index("gain"),)
        slopes = partition.simulator.derivatives(values, column)[1][:, :, 0]
        return slopes * values[:, column[0], None, None]
    if source == MEASUREMENT:
        return np.broadcast_to(np.eye(samples), (n, samples, samples)).copy()
    R, C, out, gain = (values[:, names.index(name)] for name in ("R", "C", "R_ex", "gain"))
    C = C * 1e-3
    volume, found = np.zeros((n, samples)), np.zeros((n, samples, samples))
    for k in range(1, samples):
        vented = data.u_out[:, k - 1] > 0
        fading = np.where(vented, np.exp(-data.dt[:, k - 1] / ((R + out) * C)), 1.0)
        share = np.where(vented, out / (R + out), 1.0)
        volume = volume * fading[:, None]
        here = 0.0 * R
        if source == ALVEOLUS:
            here = here + 1.0
            volume[:, k] -= np.where(vented, (1.0 - fading) * C, 0.0)
        else:
            flow = gain * 1e-3 * data.u_in[:, k - 1]
            here = R * flow
            gained = np.where(vented, (1.0 - fading) * C * out, data.dt[:, k - 1])
            volume[:, k] += gained * flow
        found[:, :, k] = share[:, None] * volume / C[:, None]
        found[:, k, k] += share * here
    return found


#: Frequencies, Hz, lengths over which a smooth source is correlated, s, and standard deviations,
#: cmH2O at the alveolus and the sensor; a tenth of that, as a share of the flow, at the supply.
FREQUENCIES = (*np.arange(0.6, 2.0, 0.1), *np.arange(2.0, 9.1, 0.25))
LENGTHS = (0.08, 0.2, 0.5)
_SIZES = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)

#: Whitened samples count up to here, and times that the noise is found anew.
_CLIP, _ROUNDS = 8.0, 3

#: Nats of the training breaths below which a source is not looked at further.
_FAINT = 8.0


@dataclass(frozen=True, eq=False)
class LatentInput:
    """A source and what it gains.

    Attributes:
        source: where it acts.
        periodic: of one frequency; else smooth.
        scale: Hz if periodic, else s.
        size: standard deviation, cmH2O or share.
        noise: beside it.
        training: log-likelihood of the training breaths with it, sum.
        held_out: of each judging breath, ``(n,)``.
        shape: its expected course in each training breath, ``(n, T)``.
    """

    source: str
    periodic: bool
    scale: float
    size: float
    noise: Noise
    training: float
    held_out: Floats
    shape: Floats


def log_likelihood_without_input(evaluator: Evaluator, fitted: FittedModel) -> tuple[float, Floats]:
    """Log-likelihoods without any source, as :class:`LatentInput` has them with one.

    Efforts of the patient, if the hypothesis has them, are integrated out.
    """
    found = []
    for partition in (evaluator.training, evaluator.held_out):
        problem, x = evaluator.refit_breath_parameters(fitted, partition)
        place = linearise(problem, x, _CLIP)
        likelihood = _plain(place, fitted.noise)
        if EFFORT in fitted.hypothesis.names:
            duration = float(fitted.column(f"{EFFORT}.duration")[0])
            likelihood = likelihood + evidence(place, duration).nats
        found.append(likelihood)
    return float(found[0].sum()), found[1]


def exceeds_sensor_noise(evaluator: Evaluator, pulled: FittedModel) -> bool:
    """Whether efforts explain more than noise of the sensor that wanders slowly.

    Args:
        evaluator: of the recording.
        pulled: a hypothesis with efforts.
    """
    passive = evaluator.fit(pulled.hypothesis.without(EFFORT), pulled.noise, pulled)
    sensor = fit_latent_inputs(evaluator, passive, (MEASUREMENT,))[MEASUREMENT]
    # On one scale: a source's likelihood leaves out what does not depend on residuals.
    weight = evaluator.held_out.data.weight
    _, scale, kept = sensor.noise._chain(weight)
    constant = sensor.noise.log_likelihood(np.zeros_like(weight), weight)
    constant += np.sum(kept * np.log(scale), axis=(1, 2))
    return (
        float((evaluator.held_out_log_likelihood(pulled) - sensor.held_out - constant).sum()) > GATE
    )


def fit_latent_inputs(
    evaluator: Evaluator, fitted: FittedModel, sources: tuple[str, ...] = LATENT_INPUTS
) -> dict[str, LatentInput]:
    """Best source at each place, its size and scale chosen by the training breaths."""
    problem, x = evaluator.refit_breath_parameters(fitted, evaluator.training)
    values = problem.values(x)

    def at(source: str) -> LatentInput:
        return _at(
            evaluator,
            fitted,
            problem,
            x,
            source,
            input_responses(evaluator.training, values, source),
        )

    return dict(zip(sources, each(at, sources), strict=True))


def _at(
    evaluator: Evaluator,
    fitted: FittedModel,
    problem: Problem,
    x: Floats,
    source: str,
    answers: Floats,
) -> LatentInput:
    noise, best = fitted.noise, None
    for _ in range(_ROUNDS):
        place = linearise(replace(problem, noise=noise), x, _CLIP)
        found = _search(place, evaluator.training, source, answers)
        total = float(_plain(place, noise).sum()) + found[0]
        if best is not None and total < best[0] + 1.0:
            break
        best = (total, noise, *found[1:])
        if found[0] < _FAINT:
            break
        noise = _left(place, evaluator.training, answers, *found[1:])
    assert best is not None
    total, noise, periodic, scale, size = best
    place = linearise(replace(problem, noise=noise), x, _CLIP)
    shape = _expected(place, evaluator.training, answers, periodic, scale, size)
    judging, own = evaluator.refit_breath_parameters(fitted)
    there = linearise(replace(judging, noise=noise), own, _CLIP)
    other = input_responses(evaluator.held_out, there.values, source)
    gained = _Kernel(there, evaluator.held_out, other, periodic, scale).gained(size)
    return LatentInput(
        source, periodic, scale, size, noise, total, _plain(there, noise) + gained, shape
    )


def _search(
    place: Linearisation, partition: Partition, source: str, answers: Floats
) -> tuple[float, bool, float, float]:
    sizes = [0.1 * size if source in (SUPPLY, GAIN) else size for size in _SIZES]
    best = (-np.inf, False, 1.0, 1.0)
    kinds = ((True, FREQUENCIES), (False, LENGTHS))
    for periodic, scales in ((False, (1.0,)),) if source == GAIN else kinds:
        for scale in scales:
            kernel = _Kernel(place, partition, answers, periodic, float(scale))
            for size in sizes:
                found = (float(kernel.gained(size).sum()), periodic, float(scale), size)
                best = max(best, found)
    return best


class _Kernel:
    """Covariance of a source of unit size, seen through the whitened recording."""

    def __init__(
        self,
        place: Linearisation,
        partition: Partition,
        answers: Floats,
        periodic: bool,
        scale: float,
    ) -> None:
        time = np.cumsum(partition.data.dt, axis=1) - partition.data.dt
        if answers.shape[1] == 1:  # one number a breath
            self.root = np.ones((len(time), 1, 1))
        elif periodic:
            angle = 2.0 * np.pi * scale * time
            self.root = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (n, 2, K)
        else:
            # Breaths of about equal intervals share their root; jitter is far below the scale.
            pace = np.round(partition.data.dt.mean(axis=1), 4)
            steps, which = np.unique(pace, return_inverse=True)
            lag = np.subtract.outer(*[np.arange(time.shape[1])] * 2)[None] * steps[:, None, None]
            values, vectors = np.linalg.eigh(np.exp(-0.5 * (lag / scale) ** 2))
            kept = int(np.max(np.sum(values > 1e-2, axis=1)))
            scaled = vectors[:, :, -kept:] * np.sqrt(np.maximum(values[:, None, -kept:], 0.0))
            self.root = scaled.swapaxes(1, 2)[which.reshape(-1)]
        rows = np.matmul(self.root, answers)[:, :, None, :]
        rows = place.without_own(place.whitened(rows))
        self.power, self.turned = np.linalg.eigh(np.matmul(rows, rows.swapaxes(1, 2)))
        self.power = np.maximum(self.power, 0.0)
        force = np.matmul(rows, place.residual[:, :, None])[:, :, 0]
        self.force = np.einsum("nij,ni->nj", self.turned, force)

    def gained(self, size: float) -> Floats:
        """Log-likelihood that a source of this size gains in each breath."""
        grown = 1.0 + size**2 * self.power
        return 0.5 * np.sum(size**2 * self.force**2 / grown - np.log(grown), axis=1)

    def expected(self, size: float) -> tuple[Floats, Floats]:
        """Expected source, ``(n, K)``, and how many numbers it takes from each breath."""
        grown = 1.0 + size**2 * self.power
        weights = np.einsum("nij,nj->ni", self.turned, size**2 * self.force / grown)
        return np.einsum("ni,nik->nk", weights, self.root), np.sum(1.0 - 1.0 / grown, axis=1)


def _expected(
    place: Linearisation,
    partition: Partition,
    answers: Floats,
    periodic: bool,
    scale: float,
    size: float,
) -> Floats:
    return -_Kernel(place, partition, answers, periodic, scale).expected(size)[0]


def _left(
    place: Linearisation,
    partition: Partition,
    answers: Floats,
    periodic: bool,
    scale: float,
    size: float,
) -> Noise:
    """Noise that is left once the expected source is taken out."""
    source, taken = _Kernel(place, partition, answers, periodic, scale).expected(size)
    data = place.problem.data
    residual = (place.seen - data.seen) * data.weight
    residual[:, 0] -= np.einsum("nk,nkt->nt", source, answers) * data.weight[:, 0]
    found = estimate(residual, data.weight)
    share = 1.0 - float(taken.sum()) / float(data.weight[:, 0].sum())
    sigma = found.sigma[0] / np.sqrt(max(share, 0.2))
    return replace(found, sigma=(sigma, *found.sigma[1:]))


def _plain(place: Linearisation, noise: Noise) -> Floats:
    """Log-likelihood of each breath without a source."""
    _, scale, weight = noise._chain(place.problem.data.weight)
    return -0.5 * np.sum(place.residual**2, axis=1) - np.sum(weight * np.log(scale), axis=(1, 2))
