"""Hardware records beside the simulated ranking: both ranks, and the gap between both scores."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ventbench.board import pages
from ventbench.board.hardware import HardwareRecord
from ventbench.board.ranking import Row, Track
from ventbench.board.record import AnyRecord, Withdrawal

#: Decimals, of cmH2O, that decide a hardware rank: measured scores repeat no better.
_DECIMALS = 3


@dataclass(frozen=True)
class HardwareRow:
    """One hardware record beside the simulated one of the same entry.

    Attributes:
        record: the hardware record.
        withdrawn: why it was taken back; None if it was not.
        newest: whether no later one of the same entry and kind of device counts instead.
        simulated: row of the entry in the simulated ranking; None if there is none.
        nominal: nominal simulated score over the same lungs and PIPs, cmH2O; NaN without one.
        rank: among the newest records over the same lungs and PIPs, from 1; None if a run was
            stopped or it does not count.
        count: how many were ranked.
    """

    record: HardwareRecord
    withdrawn: str | None
    newest: bool
    simulated: Row | None
    nominal: float
    rank: int | None = None
    count: int = 0

    @property
    def gap(self) -> float:
        """Hardware score minus simulated one, cmH2O; NaN if one does not exist."""
        return self.record.score - self.nominal

    @property
    def same_code(self) -> bool:
        """Whether both records are of the same files."""
        if self.simulated is None:
            return False
        submitted = self.simulated.record.header.submission
        return submitted.sha256 == self.record.header.submission.sha256


def rows(records: Sequence[AnyRecord], track: Track) -> list[HardwareRow]:
    """Rows of a track's hardware records, newest first.

    Args:
        records: all records, in the order of the chain.
        track: the simulated ranking.
    """
    withdrawn = {
        entry.withdraws: entry.reason for entry in records if isinstance(entry, Withdrawal)
    }
    simulated = {row.record.name: row for _, row in reversed(track.rows)}
    made: list[HardwareRow] = []
    seen: set[tuple[str, bool]] = set()
    for record in reversed(records):
        if not isinstance(record, HardwareRecord):
            continue
        if (record.version, record.track) != (track.version, track.name):
            continue
        why = withdrawn.get(record.sha256)
        newest = why is None and (record.name, record.emulated) not in seen
        if newest:
            seen.add((record.name, record.emulated))
        row = simulated.get(record.name)
        made.append(HardwareRow(record, why, newest, row, _nominal(record, row)))
    return [_ranked(row, made) for row in made]


def _nominal(record: HardwareRecord, row: Row | None) -> float:
    """Nominal simulated score over the lungs and PIPs of a hardware record, cmH2O."""
    if row is None:
        return math.nan
    simulated, header = row.record, record.header
    if not (set(header.lungs) <= set(simulated.lungs) and set(header.pips) <= set(simulated.pips)):
        return math.nan
    lungs = [simulated.lungs.index(lung) for lung in header.lungs]
    pips = [simulated.pips.index(pip) for pip in header.pips]
    return float(simulated.nominal[np.ix_(lungs, pips)].mean())


def _ranked(row: HardwareRow, all_rows: Sequence[HardwareRow]) -> HardwareRow:
    if not row.newest or not math.isfinite(row.record.score):
        return row
    scores = [
        round(other.record.score, _DECIMALS)
        for other in all_rows
        if other.newest and math.isfinite(other.record.score) and _cells(other) == _cells(row)
    ]
    own = round(row.record.score, _DECIMALS)
    return replace(row, rank=1 + sum(score < own for score in scores), count=len(scores))


def _cells(row: HardwareRow) -> tuple[Any, ...]:
    """What two records must share to be ranked against each other."""
    header = row.record.header
    return header.device.emulated, frozenset(header.lungs), frozenset(header.pips)


def of_entry(made: Sequence[HardwareRow], name: str) -> HardwareRow | None:
    """The row that stands for an entry: a physical lung's before an emulator's."""
    counting = [row for row in made if row.newest and row.record.name == name]
    return min(counting, key=lambda row: row.record.emulated, default=None)


def shown(row: HardwareRow) -> dict[str, Any]:
    """A row for the templates."""
    record, header = row.record, row.record.header
    kind = "emulator" if record.emulated else header.device.name
    spread = "" if math.isnan(record.spread) else f" (SD {pages.figure(record.spread)})"
    return {
        "name": record.name,
        "sha256": record.sha256,
        "path": pages.entry_path(record.version, record.track, record.name),
        "listed": row.simulated is not None,
        "value": f"{record.score:.9f}" if math.isfinite(record.score) else "",
        "score": pages.figure(record.score) if math.isfinite(record.score) else "stopped",
        "spread": spread,
        "rank": row.rank,
        "count": row.count,
        "simulated_rank": row.simulated.rank if row.simulated else None,
        "nominal": pages.figure(row.nominal),
        "gap": pages.signed(row.gap),
        "same_code": row.same_code,
        "device": kind,
        "firmware": header.device.firmware,
        "calibration": header.device.calibration[:12],
        "emulated": record.emulated,
        "operator": header.operator,
        "notes": header.notes,
        "created": header.created,
        "lungs": [
            {
                "name": lung,
                "score": pages.figure(float(record.by_lung[i])),
                "peak": pages.figure(header.peak_pressure_cmH2O[i], 1),
                "safe": header.safe[i],
            }
            for i, lung in enumerate(header.lungs)
        ],
        "pips": ", ".join(f"{pip:g}" for pip in header.pips),
        "repeats": header.repeats,
        "stops": [
            f"{stop.lung}, PIP {stop.pip:g}, repetition {stop.repeat}: {stop.reason}"
            for stop in header.stops
        ],
        "withdrawn": row.withdrawn,
        "newest": row.newest,
        "recording": header.recording.sha256,
    }
