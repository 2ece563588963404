"""Recordings at high sampling rates, on a coarser grid that keeps the commands as they were.

Averaging or interpolating commands to a lower rate moves their edges; a simulator that follows them
then seems to lag. Here, a sample is kept wherever a command changes. Between two kept samples the
commands are constant up to a small tolerance and stand at their mean, so that the delivered volume
is exact. Readings are those of the kept samples, never averages.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.recordings.bad_samples import MEASURED
from ventbench.recordings.breaths import Breaths, arranged, valid_mask

#: Median sampling interval, s, below which a recording is decimated. The dynamics that pressure can
#: show have time constants of 10 ms and more.
FAST = 0.015

#: Interval of the readings that are kept, s.
_READINGS = 0.02

#: Least time between two readings that are kept, s: where commands change at every sample, more
#: readings would only weigh a few milliseconds of the breath more than the rest.
_LEAST = 0.005

#: Largest departure of a command from its mean between two kept samples, %. At R = 50 it makes a
#: difference of 0.3 cmH2O for a few milliseconds.
_TOLERANCE = 0.25

#: Departure of the last command before a reading from that mean, %, from which the sample before
#: the reading is kept too: a pressure shows the flow of its own moment.
_AT_READING = 0.02

#: Most samples of a breath. A command that follows the noise of a fast sensor changes at every
#: sample; the tolerance is then raised, since the lung averages such changes.
_MOST = 400

#: Factor by which the tolerance is raised.
_COARSER = 1.6

#: Numbers of samples are multiples of this, so that compiled functions are used again.
_MULTIPLE = 20


@dataclass(frozen=True, eq=False)
class Decimation:
    """Breaths on a coarser grid."""

    breaths: Breaths  #: n breaths; pressures at samples that are only kept for a command are blank.
    #: sample of the full recording at each kept sample, ``(n, T)``; padding repeats the last.
    index: Ints

    def of(self, values: Floats) -> Floats:
        """Values at the kept samples, ``(n, T)``, of values at all samples."""
        return np.take_along_axis(values, self.index, axis=1)


def is_fast(breaths: Breaths) -> bool:
    """Whether breaths are sampled so fast that a diagnosis decimates them."""
    return bool(np.median(breaths.dt[breaths.valid]) < FAST)


def decimate(breaths: Breaths) -> Decimation:
    """Keep a reading every 20 ms and a sample at every change of a command, at any rate.

    ``valid``, ``time`` and ``dt`` are of the kept samples. ``sha256`` still names the file.
    """
    lengths = breaths.valid.sum(axis=1)
    grids = [_nodes(breaths, i, int(length)) for i, length in enumerate(lengths)]
    counts = np.array([len(nodes) for nodes, _ in grids])
    width = -(-int(counts.max()) // _MULTIPLE) * _MULTIPLE
    index = np.stack([np.pad(nodes, (0, width - len(nodes)), mode="edge") for nodes, _ in grids])
    kept = valid_mask(counts, width)
    flat = {
        name: np.take_along_axis(values, index, axis=1)[kept]
        for name in ("time", "u_out", *MEASURED)
        if (values := getattr(breaths, name)) is not None
    }
    means = [_means(breaths.u_in[i], breaths.dt[i], nodes) for i, (nodes, _) in enumerate(grids)]
    read = [np.isin(nodes, readings) for nodes, readings in grids]
    flat |= {"u_in": np.concatenate(means)}
    flat["pressure"][~np.concatenate(read)] = np.nan
    same = ("breath_id", "R", "C", "time_inferred", "source", "sha256", "notes")
    rest = {name: getattr(breaths, name) for name in same}
    return Decimation(arranged(counts, flat.pop("time"), flat, width, **rest), index)


def _nodes(breaths: Breaths, i: int, length: int) -> tuple[Ints, Ints]:
    """Samples of a breath that are kept, in order, and those of them that are readings.

    The first and the last sample are kept.
    """
    time, u_out = breaths.time[i, :length], breaths.u_out[i, :length]
    every = max(_READINGS, time[-1] / (_MOST / 2))
    # The first sample at or after each multiple of the interval.
    readings = np.searchsorted(time, np.arange(0.0, time[-1] + every, every) - 1e-9)
    switched = np.flatnonzero(np.diff(u_out)) + 1
    fixed = np.concatenate([readings[readings < length], switched, [0, length - 1]])
    tolerance = _TOLERANCE
    while True:
        nodes = np.unique(np.concatenate([fixed, _changes(breaths.u_in[i, :length], tolerance)]))
        if len(nodes) <= max(_MOST, len(np.unique(fixed)) + 2):
            break
        tolerance *= _COARSER
    u_in = breaths.u_in[i]
    apart = np.abs(u_in[nodes[1:] - 1] - _means(u_in, breaths.dt[i], nodes)[:-1]) > _AT_READING
    spaced = _spaced(time[nodes])
    before = nodes[1:][spaced[1:] & apart] - 1
    return np.unique(np.concatenate([nodes, before])), nodes[spaced]


def _changes(u_in: Floats, tolerance: float) -> Ints:
    """First samples of runs in which the command stays within a band of twice the tolerance."""
    starts, low, high = [0], u_in[0], u_in[0]
    for k, value in enumerate(u_in.tolist()):
        low, high = min(low, value), max(high, value)
        if high - low > 2.0 * tolerance:
            starts.append(k)
            low = high = value
    return np.array(starts)


def _means(u_in: Floats, dt: Floats, nodes: Ints) -> Floats:
    """Mean command from each kept sample to the next, ``(k,)``; the last stands as it is."""
    volume = np.concatenate([[0.0], np.cumsum(u_in * dt)])
    passed = np.concatenate([[0.0], np.cumsum(dt)])
    means = np.diff(volume[nodes]) / np.diff(passed[nodes])
    return np.append(means, u_in[nodes[-1]])


def _spaced(time: Floats) -> Bools:
    """Whether a sample comes long enough after the last reading that is kept, ``(k,)``."""
    selected, last = np.zeros(len(time), bool), -np.inf
    for k, now in enumerate(time.tolist()):
        if now - last >= _LEAST - 1e-9:
            selected[k], last = True, now
    return selected
