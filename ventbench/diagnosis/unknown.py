"""The rival of whatever differs from breath to breath: an error that nobody can place.

A ripple of the supply, secretions in some breaths or lost commands are fitted with numbers of each
breath, and so take much of *any* error that differs from breath to breath, such as breath numbers
that are off by one. Their rival says no more than that: in an unknown share of the breaths the
pressure is off by a smooth course of its own,

    p(breath b) = (1 - share) N(e_b | 0, K) + share N(e_b | 0, K + sd^2 H H'),

with hat functions ``H`` of the time in the breath. A name that is right predicts the breaths with
fewer numbers, and wins; one that is a bin does not.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.evidence import WARMTH
from ventbench.diagnosis.hypothesis import FittedModel, Partition
from ventbench.system_id.data import Data

#: Distance of the hat functions, s: the time constant of a slow valve or of a stiff lung.
_SPACING = 0.15

#: Standard deviations of the course, cmH2O, and shares of the breaths; each pair is as likely.
_SIZES, _SHARES = (0.3, 1.0, 3.0, 10.0), (0.1, 0.3, 0.6, 0.95)


def unplaced_gain(evaluator: Evaluator, fitted: FittedModel, partition: Partition) -> float:
    """Log-likelihood that breaths gain if they err by courses of their own, nats.

    The course is integrated out, share and size are summed over.

    Args:
        evaluator: evaluator of the recording.
        fitted: the model beside it.
        partition: n breaths.
    """
    linear = evaluator.linearised(fitted, partition)
    hats = _hats(partition.data)
    spreads = (np.full(hats.shape[1], size) for size in _SIZES)
    totals = [linear.integrate_out(hats, sd)[0] for sd in spreads]
    log_evidence = [mixture(share, gained).sum() for gained, share in product(totals, _SHARES)]
    return float(np.logaddexp.reduce(log_evidence) - np.log(len(log_evidence)))


def mixture(share: Floats | float, gained: Floats) -> Floats:
    """Log-likelihood that breaths gain if an effect acts in a share of them, of what it gains."""
    return np.logaddexp(np.log1p(-share), np.log(share) + gained)


def preference(nats: float) -> float:
    """Posterior probability of an answer that is so many nats ahead of its only rival."""
    return 1.0 / (1.0 + math.exp(-max(min(WARMTH * nats, 50.0), -50.0)))


def explained(
    evaluator: Evaluator, fitted: FittedModel, partition: Partition, nats: float
) -> tuple[float, float]:
    """Worth of a term by the log-likelihood that it gains, and its share of what is no noise.

    Whitened noise alone loses half a nat a reading; a term that gains all that is lost beyond it
    explains all. The squared error falls by the same share.

    Args:
        evaluator: evaluator of the recording.
        fitted: the model beside the term.
        partition: n breaths.
        nats: log-likelihood that they gain by the term.

    Returns:
        Root-mean-square error that the term takes away, cmH2O, and the share, 0..1.
    """
    linear = evaluator.linearised(fitted, partition)
    count = float(np.sum(partition.data.weight > 0.0))
    lost = float(linear.problem.noise.loss(linear.residual).sum()) - 0.5 * count
    share = min(max(nats, 0.0) / max(lost, nats, 1e-9), 1.0)
    before = evaluator.mean_square(fitted, partition)
    above = max(before - linear.problem.noise.sigma[0] ** 2, 0.0)
    return float(np.sqrt(before) - np.sqrt(before - share * above)), share


def _hats(data: Data) -> Floats:
    """Hat functions of the time in the breath, ``(n, k, T)``."""
    time = np.cumsum(data.dt, axis=1) - data.dt
    centres = np.arange(0.0, float(time.max()) + _SPACING, _SPACING)
    return np.maximum(1.0 - np.abs(time[:, None] - centres[:, None]) / _SPACING, 0.0)
