"""Rig and session of a breath of the real ventilators, by its times alone.

The public recordings are from a farm of ventilators that nothing names. Their clocks do: a rig runs
at about 31.8 ms or about 34.0 ms a sample; on some rigs a share of the samples comes late
("spiky"); and the number of samples in one second of inspiration tells program versions apart. A
*session* is a lung setting with one such clock. A session's breaths share what changes when
somebody sets up a lung: gain of the valve, actual resistance and compliance.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths

#: Between fast and slow rigs, ms.
_FAST_MS = 32.9
# A sample is late if its interval exceeds the median by so much (ms); a rig with more than this
# share of late samples is spiky.
_LATE_MS, _SPIKY_SHARE = 0.5, 0.03
# Sessions differ in interval by at least this gap, ms; smaller groups join the nearest one.
_GAP_MS, _SMALLEST = 0.25, 5
# Distances to a session: one unit is this many ms, one sample of inspiration, or part of a spike.
_UNIT_MS, _SPIKE_UNITS, _MOST_SAMPLES = 0.2, 1.5, 2.0


@dataclass(frozen=True)
class SampleTiming:
    """Sampling of n breaths, read off their times; every array has shape ``(n,)``."""

    interval_ms: Floats  #: median sampling interval, ms.
    spiky: Bools  #: whether more than a few samples come late.
    inspiratory: Ints  #: number of inspiratory samples.
    known: Bools  #: False where times were blank, so that ``spiky`` says nothing.


def sample_timing(breaths: Breaths) -> SampleTiming:
    """Read the sampling of breaths off their times."""
    interval = np.where(breaths.valid[:, 1:], breaths.dt[:, :-1] * 1000.0, np.nan)
    median = np.nanmedian(interval, axis=1)
    late = np.nanmean(interval - median[:, None] > _LATE_MS, axis=1)
    inspiratory = np.count_nonzero(breaths.inspiratory, axis=1)
    return SampleTiming(median, late > _SPIKY_SHARE, inspiratory, ~breaths.time_inferred)


@dataclass(frozen=True)
class Session:
    """One session."""

    lung: str  #: id of the setting, such as ``R20C50``.
    interval_ms: float  #: median sampling interval, ms.
    spiky: bool  #: whether the rig is a spiky one.
    inspiratory: int  #: most frequent number of inspiratory samples.
    breaths: int  #: number of breaths that defined it.

    @property
    def rig(self) -> int:
        """Kind of rig: 0 slow, 1 slow and spiky, 2 fast, 3 fast and spiky."""
        return 2 * (self.interval_ms < _FAST_MS) + self.spiky


@dataclass(frozen=True)
class Sessions:
    """The known sessions, in a fixed order."""

    table: tuple[Session, ...]

    def __len__(self) -> int:
        """Number of sessions."""
        return len(self.table)

    def assign(self, breaths: Breaths) -> Ints:
        """Index into :attr:`table` of each breath, ``(n,)``: the nearest clock of its lung.

        A combination that was never seen thus falls to the one most like it.

        Raises:
            InputError: if no session has a breath's lung.
        """
        timing = sample_timing(breaths)
        out = np.empty(len(breaths), np.int64)
        for lung, index in breaths.by_lung_index.items():
            candidates = [i for i, session in enumerate(self.table) if session.lung == lung]
            if not candidates:
                lungs = ", ".join(dict.fromkeys(session.lung for session in self.table))
                raise InputError(
                    f"breath {breaths.breath_id[index[0]]} is of lung {lung}, for which there is "
                    f"no simulator; known are {lungs}"
                )
            distances = np.stack([self._distance(timing, index, self.table[i]) for i in candidates])
            out[index] = np.array(candidates)[np.argmin(distances, axis=0)]
        return out

    @staticmethod
    def _distance(timing: SampleTiming, index: Ints, to: Session) -> Floats:
        samples = np.abs(timing.inspiratory[index] - to.inspiratory)
        spike = (timing.spiky[index] != to.spiky) & timing.known[index]
        return (
            np.abs(timing.interval_ms[index] - to.interval_ms) / _UNIT_MS
            # The number of samples of a spiky rig varies by itself.
            + np.minimum(samples, _MOST_SAMPLES) * (0.5 if to.spiky else 1.0)
            + spike * _SPIKE_UNITS
        )

    def rigs(self) -> Ints:
        """Kind of rig of each session."""
        return np.array([session.rig for session in self.table])

    def to_list(self) -> list[dict[str, Any]]:
        """Plain values for a manifest."""
        return [asdict(session) for session in self.table]

    @classmethod
    def from_list(cls, plain: list[dict[str, Any]]) -> Sessions:
        """Read what :meth:`to_list` gave.

        Raises:
            InputError: if it is not that.
        """
        try:
            return cls(tuple(Session(**row) for row in plain))
        except TypeError as error:
            raise InputError(f"the table of sessions is not one: {error}") from error


def find(breaths: Breaths) -> Sessions:
    """Make the table of sessions from breaths, which should be those of the training.

    Breaths of one lung belong together if their rigs are of one kind, their intervals leave no gap
    and, on rigs that are not spiky, they have equally many inspiratory samples.
    """
    timing = sample_timing(breaths)
    rows: list[Session] = []
    for lung, index in breaths.by_lung_index.items():
        groups = _groups(timing, index)
        large = [group for group in groups if len(group) >= _SMALLEST]
        for group in large or [index]:
            counts = np.bincount(timing.inspiratory[group])
            interval = round(float(np.median(timing.interval_ms[group])), 3)
            spiky = bool(np.mean(timing.spiky[group]) > 0.5)
            rows.append(Session(lung, interval, spiky, int(counts.argmax()), len(group)))
    return Sessions(tuple(rows))


def _groups(timing: SampleTiming, index: Ints) -> list[Ints]:
    groups = []
    for spiky in (False, True):
        some = index[timing.spiky[index] == spiky]
        some = some[np.argsort(timing.interval_ms[some], kind="stable")]
        cuts = np.flatnonzero(np.diff(timing.interval_ms[some]) > _GAP_MS) + 1
        for part in np.split(some, cuts):
            kinds = [0] if spiky else np.unique(timing.inspiratory[part]).tolist()
            groups += [part[timing.inspiratory[part] == k] if k else part for k in kinds]
    return [group for group in groups if group.size]
