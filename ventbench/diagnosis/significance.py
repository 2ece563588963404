"""Whether means over breaths differ from zero, for many ranges at once, by flips of whole breaths.

Breaths are the independent unit: samples within one share its noise. If there is nothing to find,
a breath's errors are as likely with the opposite sign, all ranges together; so the largest
statistic over all ranges under random flips tells how large chance makes it (Westfall and Young,
Resampling-Based Multiple Testing, 1993).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

#: Random flips; a p-value is at least one over one more than these.
FLIPS = 2000

#: Fewest breaths that a range must have.
FEWEST = 5


def statistic(values: Floats, weight: Floats | None = None) -> Floats:
    """Sum over breaths by the root of the sum of squares: t without its heavy tails.

    It rises with Student's t, ``t = z sqrt((n - 1) / (n - z^2))``, but never exceeds ``sqrt(n)``:
    a range that few breaths have cannot outdo all others by chance.

    Args:
        values: of each breath and range, NaN where it has none, ``(n, k)``.
        weight: by which each range's statistic is multiplied, ``(k,)``.

    Returns:
        Shape ``(k,)``; zero for ranges with fewer than :data:`FEWEST` breaths.
    """
    filled, scale = _scaled(values, weight)
    return filled.sum(axis=0) * scale


def p_values(values: Floats, *, two_sided: bool, seed: int, weight: Floats | None = None) -> Floats:
    """Probability that chance alone gives any range a statistic as large, ``(k,)``.

    Args:
        values: as in :func:`statistic`.
        two_sided: whether large negative means count too.
        seed: of the flips.
        weight: as in :func:`statistic`; only for what is seen, not for the flips.
    """
    filled, scale = _scaled(values, None)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(FLIPS, len(values)))
    flipped, seen = (signs @ filled) * scale, statistic(values, weight)
    if two_sided:
        flipped, seen = np.abs(flipped), np.abs(seen)
    largest = np.sort(flipped.max(axis=1, initial=0.0))
    above = FLIPS - np.searchsorted(largest, seen * (1.0 - 1e-12), side="left")
    return np.where(scale > 0, (1.0 + above) / (1.0 + FLIPS), 1.0)


def _scaled(values: Floats, weight: Floats | None) -> tuple[Floats, Floats]:
    there = np.isfinite(values)
    filled = np.where(there, values, 0.0)
    norm = np.sqrt(np.sum(filled**2, axis=0))
    enough = (there.sum(axis=0) >= FEWEST) & (norm > 0)
    scale = np.divide(1.0, norm, out=np.zeros_like(norm), where=enough)
    return filled, scale if weight is None else scale * weight
