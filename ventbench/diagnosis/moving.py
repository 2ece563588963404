"""Evidence for sources that move in time, in each breath in its own way.

A source is a Gaussian process, smooth or of one frequency, independent from breath to breath, and
is integrated out: only its size and scale are fitted. Coloured noise is such a source at the
sensor, and so has to be beaten by one that sits in the physics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ventbench.diagnosis.bench import Bench
from ventbench.diagnosis.effort import EFFORT, evidence
from ventbench.diagnosis.gate import GATE
from ventbench.diagnosis.linear import Local, local
from ventbench.diagnosis.solved import Side, Solved
from ventbench.diagnosis.sources import GAIN, MEASUREMENT, SOURCES, SUPPLY, responses
from ventbench.system_id.data import Floats
from ventbench.system_id.noise import Noise, estimate
from ventbench.system_id.problem import Problem
from ventbench.system_id.together import each

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
class Moving:
    """A source and what it gains.

    Attributes:
        source: where it acts.
        periodic: of one frequency; else smooth.
        scale: Hz if periodic, else s.
        size: standard deviation, cmH2O or share.
        noise: beside it.
        training: log-likelihood of the training breaths with it, sum.
        judged: of each judging breath, ``(n,)``.
        shape: its expected course in each training breath, ``(n, T)``.
    """

    source: str
    periodic: bool
    scale: float
    size: float
    noise: Noise
    training: float
    judged: Floats
    shape: Floats


def without(bench: Bench, solved: Solved) -> tuple[float, Floats]:
    """Log-likelihoods without any source, as :class:`Moving` has them with one.

    Efforts of the patient, if the hypothesis has them, are integrated out.
    """
    found = []
    for side in (bench.training, bench.judging):
        problem, x = bench.judge(solved, side)
        place = local(problem, x, _CLIP)
        likelihood = _plain(place, solved.noise)
        if EFFORT in solved.hypothesis.names:
            duration = float(solved.column(f"{EFFORT}.duration")[0])
            likelihood = likelihood + evidence(place, duration).nats
        found.append(likelihood)
    return float(found[0].sum()), found[1]


def beats_noise(bench: Bench, pulled: Solved) -> bool:
    """Whether efforts explain more than noise of the sensor that wanders slowly.

    Args:
        bench: of the recording.
        pulled: a hypothesis with efforts.
    """
    passive = bench.solve(pulled.hypothesis.without(EFFORT), pulled.noise, pulled)
    sensor = moving(bench, passive, (MEASUREMENT,))[MEASUREMENT]
    # On one scale: a source's likelihood leaves out what does not depend on residuals.
    weight = bench.judging.data.weight
    _, scale, kept = sensor.noise._chain(weight)
    constant = sensor.noise.log_likelihood(np.zeros_like(weight), weight)
    constant += np.sum(kept * np.log(scale), axis=(1, 2))
    return float((bench.judged(pulled) - sensor.judged - constant).sum()) > GATE


def moving(bench: Bench, solved: Solved, sources: tuple[str, ...] = SOURCES) -> dict[str, Moving]:
    """Best source at each place, its size and scale chosen by the training breaths."""
    problem, x = bench.judge(solved, bench.training)
    values = problem.values(x)

    def at(source: str) -> Moving:
        return _at(bench, solved, problem, x, source, responses(bench.training, values, source))

    return dict(zip(sources, each(at, sources), strict=True))


def _at(
    bench: Bench, solved: Solved, problem: Problem, x: Floats, source: str, answers: Floats
) -> Moving:
    noise, best = solved.noise, None
    for _ in range(_ROUNDS):
        place = local(replace(problem, noise=noise), x, _CLIP)
        found = _search(place, bench.training, source, answers)
        total = float(_plain(place, noise).sum()) + found[0]
        if best is not None and total < best[0] + 1.0:
            break
        best = (total, noise, *found[1:])
        if found[0] < _FAINT:
            break
        noise = _left(place, bench.training, answers, *found[1:])
    assert best is not None
    total, noise, periodic, scale, size = best
    place = local(replace(problem, noise=noise), x, _CLIP)
    shape = _expected(place, bench.training, answers, periodic, scale, size)
    judging, own = bench.judge(solved)
    there = local(replace(judging, noise=noise), own, _CLIP)
    other = responses(bench.judging, there.values, source)
    gained = _Kernel(there, bench.judging, other, periodic, scale).gained(size)
    return Moving(source, periodic, scale, size, noise, total, _plain(there, noise) + gained, shape)


def _search(
    place: Local, side: Side, source: str, answers: Floats
) -> tuple[float, bool, float, float]:
    sizes = [0.1 * size if source in (SUPPLY, GAIN) else size for size in _SIZES]
    best = (-np.inf, False, 1.0, 1.0)
    kinds = ((True, FREQUENCIES), (False, LENGTHS))
    for periodic, scales in ((False, (1.0,)),) if source == GAIN else kinds:
        for scale in scales:
            kernel = _Kernel(place, side, answers, periodic, float(scale))
            for size in sizes:
                found = (float(kernel.gained(size).sum()), periodic, float(scale), size)
                best = max(best, found)
    return best


class _Kernel:
    """Covariance of a source of unit size, seen through the whitened recording."""

    def __init__(
        self, place: Local, side: Side, answers: Floats, periodic: bool, scale: float
    ) -> None:
        time = np.cumsum(side.data.dt, axis=1) - side.data.dt
        if answers.shape[1] == 1:  # one number a breath
            self.root = np.ones((len(time), 1, 1))
        elif periodic:
            angle = 2.0 * np.pi * scale * time
            self.root = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (n, 2, K)
        else:
            # Breaths of about equal intervals share their root; jitter is far below the scale.
            pace = np.round(side.data.dt.mean(axis=1), 4)
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
    place: Local, side: Side, answers: Floats, periodic: bool, scale: float, size: float
) -> Floats:
    return -_Kernel(place, side, answers, periodic, scale).expected(size)[0]


def _left(
    place: Local, side: Side, answers: Floats, periodic: bool, scale: float, size: float
) -> Noise:
    """Noise that is left once the expected source is taken out."""
    source, taken = _Kernel(place, side, answers, periodic, scale).expected(size)
    data = place.problem.data
    residual = (place.seen - data.seen) * data.weight
    residual[:, 0] -= np.einsum("nk,nkt->nt", source, answers) * data.weight[:, 0]
    found = estimate(residual, data.weight)
    share = 1.0 - float(taken.sum()) / float(data.weight[:, 0].sum())
    sigma = found.sigma[0] / np.sqrt(max(share, 0.2))
    return replace(found, sigma=(sigma, *found.sigma[1:]))


def _plain(place: Local, noise: Noise) -> Floats:
    """Log-likelihood of each breath without a source."""
    _, scale, weight = noise._chain(place.problem.data.weight)
    return -0.5 * np.sum(place.residual**2, axis=1) - np.sum(weight * np.log(scale), axis=(1, 2))
