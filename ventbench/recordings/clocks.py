"""Ventilators that recorded a file, told apart by their clocks.

A file may hold the breaths of several ventilators that nothing names, as a farm of them that tests
run on gives. Each samples at its own interval. Within one, intervals of breaths lie close together;
between two, there is a gap.
"""

from __future__ import annotations

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.recordings.breaths import Breaths

#: Sampling intervals of one ventilator are dense: its median interval moves by a few per mille from
#: breath to breath. Two ventilators differ by more than a clock that counts milliseconds can err.
_DENSE, _APART = 1.005, 1.04

#: Fewest breaths that tell of a ventilator, in all and of a lung: two fit R and C, one tests.
FEWEST = 3


def sampling_intervals(breaths: Breaths) -> Floats:
    """Median time between the samples of each of n breaths, s, ``(n,)``."""
    return np.nanmedian(np.where(breaths.valid, breaths.dt, np.nan), axis=1)


def rigs_by_clock(breaths: Breaths) -> Ints:
    """Index of the ventilator of each of n breaths, from 0, ``(n,)``.

    Breaths between two ventilators count as those of the nearer one; a ventilator with few breaths
    of a lung counts as the one that has most of that lung.
    """
    interval = np.log(sampling_intervals(breaths))
    order = np.argsort(interval, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(interval[order]) > np.log(_DENSE)) + 1)
    centres: list[float] = []
    for centre in (float(np.median(interval[g])) for g in groups if len(g) >= FEWEST):
        if not centres or centre - centres[-1] > np.log(_APART):
            centres.append(centre)
    if len(centres) < 2:
        return np.zeros(len(breaths), int)
    rigs = np.argmin(np.abs(interval[:, None] - np.array(centres)), axis=1)
    for index in breaths.by_lung_index.values():
        counts = np.bincount(rigs[index])
        rigs[index] = np.where(counts[rigs[index]] < FEWEST, counts.argmax(), rigs[index])
    return rigs
