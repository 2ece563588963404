"""From records to a board: which record of an entry counts, its rank, intervals and differences.

The ranked score of an entry is the mean of its normalised score over draws, lungs and PIPs. Draws,
their rigs and members of the ensemble are common to all entries and resampled alike, so that every
interval of a difference is a paired one. Stress ranks compare entries of the robustness track under
missing physics, hardware ranks those that ran on the same lungs and PIPs of a bench. No rank of any
kind without somebody who vouches for the record; see :mod:`ventbench.board.attestation`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.board.record import AnyRecord, HardwareRecord, Record, Withdrawal
from ventbench.board.store import Store
from ventbench.entries.manifest import TRACKS
from ventbench.entries.runs import Runs
from ventbench.task.metrics import bootstrap

Floats = NDArray[np.float64]

#: The PID that each track's entries are compared with.
BASELINES = {"performance": "pid_best", "robustness": "pid_robust"}

#: Decimals that decide: replays agree to so many, so that no machine decides a tie.
DECIMALS = 9

#: Decimals, of cmH2O, that decide a hardware rank: measured scores repeat no better.
_MEASURED_DECIMALS = 3

#: Most characters of a failure's message that a reason quotes; a submission chose them.
MAX_QUOTED = 300

#: Why a record has no rank although its sandbox was official.
UNATTESTED = "not official: no key of this leaderboard has signed the record"


@dataclass(frozen=True)
class Event:
    """One record of an entry's history.

    Attributes:
        record: the record.
        withdrawn: why it was taken back; None if it was not.
        attested: whether somebody vouches for it; see :mod:`ventbench.board.attestation`.
    """

    record: Record
    withdrawn: str | None
    attested: bool

    @property
    def official(self) -> bool:
        """Whether its sandbox deserves the word, and somebody vouches for that."""
        return self.record.official and self.attested


@dataclass(frozen=True)
class Entry:
    """A submission on one track, by the record that counts.

    Attributes:
        record: the newest one: of the official ones if there are any.
        history: all of its records, newest first.
        reasons: why it is not ranked; empty if it is.
    """

    record: Record
    history: tuple[Event, ...]
    reasons: tuple[str, ...]


@dataclass
class Standing:
    """One track of the board.

    Attributes:
        ranked: official, complete and safe entries, in no order yet.
        unranked: official entries that are not ranked, with reasons.
        unofficial: newest unofficial record of each submission without a newer official one.
    """

    ranked: list[Entry] = field(default_factory=list)
    unranked: list[Entry] = field(default_factory=list)
    unofficial: list[Entry] = field(default_factory=list)


@dataclass(frozen=True)
class Interval:
    """A figure with its 95 % interval, cmH2O or points of the normalised score."""

    value: float
    low: float
    high: float

    @property
    def clear(self) -> bool:
        """Whether zero is outside, by more than rounding."""
        least = 10.0**-DECIMALS
        return self.low > least or self.high < -least


@dataclass(frozen=True)
class Comparison:
    """A score, and its differences to others.

    Attributes:
        score: mean over draws.
        to_baseline: difference to the track's PID; None for the PID itself, or without one.
        to_above: difference to the entry above; None for the first.
    """

    score: Interval
    to_baseline: Interval | None
    to_above: Interval | None


@dataclass(frozen=True)
class Row:
    """One ranked entry, or one shown beside them.

    Attributes:
        entry: whose row it is.
        rank: from 1; None if it is not ranked. See :func:`rank_ranges`.
        ranks: ranks that it may have; None if it is not ranked.
        normalised: the normalised score, which ranks; None if a cell failed.
        error: the error of the same runs, cmH2O; None if a cell failed.
        nominal: the paper's score, cmH2O; NaN if a cell failed.
        worst: highest mean over draws of one cell, cmH2O, its lung and PIP; NaN if one failed.
    """

    entry: Entry
    rank: int | None
    ranks: tuple[int, int] | None
    normalised: Comparison | None
    error: Interval | None
    nominal: float
    worst: tuple[float, str, float]

    @property
    def record(self) -> Record:
        """The record that counts."""
        return self.entry.record


@dataclass(frozen=True)
class StressRow:
    """One entry under missing physics.

    Attributes:
        row: of the entry on the robustness track.
        tables: its stressed runs.
        score: stress score with its interval, cmH2O; None if a run failed.
        rank: 1 + the number of entries that are better beyond doubt; None if a run failed.
        ranks: ranks that it may have.
    """

    row: Row
    tables: Runs
    score: Interval | None = None
    rank: int | None = None
    ranks: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """Name of the entry."""
        return self.row.record.name


@dataclass(frozen=True)
class HardwareRow:
    """One hardware record beside the simulated one of the same entry.

    Attributes:
        record: the hardware record.
        withdrawn: why it was taken back; None if it was not.
        attested: whether somebody vouches for it.
        newest: whether no later one of the same entry and kind of device counts instead.
        simulated: row of the entry in the simulated ranking; None if there is none.
        nominal: nominal simulated score over the same lungs and PIPs, cmH2O; NaN without one.
        rank: among the newest attested records over the same lungs and PIPs, from 1; None if a run
            was stopped or it does not count.
        count: how many were ranked.
    """

    record: HardwareRecord
    withdrawn: str | None
    attested: bool
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

    @property
    def comparable(self) -> tuple[Any, ...] | None:
        """What it must share with another one to be ranked against it; None if it has no rank."""
        if not (self.attested and self.newest and math.isfinite(self.record.score)):
            return None
        header = self.record.header
        return self.record.emulated, frozenset(header.lungs), frozenset(header.pips)


@dataclass(frozen=True)
class Track:
    """One track of the board.

    Attributes:
        name: ``"performance"`` or ``"robustness"``.
        ranked: best first.
        unranked: official entries that are not ranked, with reasons, by name.
        unofficial: entries that nobody vouches for, or without a full sandbox, by name.
        baseline: record of the track's PID, that the others are compared with; None if there is no
            ranked one.
        stress: ranked entries that ran under the newest table of stressors, best first.
        hardware: hardware records of the track, newest first.
    """

    name: str
    ranked: tuple[Row, ...]
    unranked: tuple[Row, ...]
    unofficial: tuple[Row, ...]
    baseline: Record | None
    stress: tuple[StressRow, ...]
    hardware: tuple[HardwareRow, ...]

    @property
    def rows(self) -> list[tuple[str, Row]]:
        """All rows with their status, in the order in which they are shown."""
        kinds = ("ranked", "not ranked", "not official")
        groups = (self.ranked, self.unranked, self.unofficial)
        return [(kind, row) for kind, rows in zip(kinds, groups, strict=True) for row in rows]


def board(leaderboard: Store) -> tuple[Track, ...]:
    """Rank all records of a leaderboard: both tracks."""
    return tuple(
        _track(leaderboard, name, standing) for name, standing in standings(leaderboard).items()
    )


def _track(leaderboard: Store, name: str, standing: Standing) -> Track:
    ranked = rank(standing.ranked, name)
    records = [row.record for row in ranked]
    base = baseline(records, name)
    track = Track(
        name=name,
        ranked=tuple(ranked),
        unranked=tuple(unranked_rows(standing.unranked)),
        unofficial=tuple(unranked_rows(standing.unofficial)),
        baseline=None if base is None else records[base],
        stress=tuple(stress_rows(ranked)),
        hardware=(),
    )
    measured = hardware_rows(leaderboard.records, leaderboard.attested, track)
    return replace(track, hardware=tuple(measured))


def standings(leaderboard: Store) -> dict[str, Standing]:
    """Sort the records of a leaderboard into tracks, by their names."""
    withdrawn = _withdrawn(leaderboard.records)
    grouped: dict[tuple[str, str], list[Event]] = defaultdict(list)
    for record in leaderboard.scores:
        sha256 = record.sha256
        event = Event(record, withdrawn.get(sha256), sha256 in leaderboard.attested)
        grouped[record.key].insert(0, event)
    tracks = {name: Standing() for name in TRACKS}
    for (track, _), history in sorted(grouped.items()):
        _place(tracks[track], tuple(history))
    return tracks


def _withdrawn(records: Sequence[AnyRecord]) -> dict[str, str]:
    """Why records were taken back, by their hashes."""
    return {entry.withdraws: entry.reason for entry in records if isinstance(entry, Withdrawal)}


def _place(standing: Standing, history: tuple[Event, ...]) -> None:
    counts = next((event for event in history if event.official), None)
    if counts is not None:
        why = reasons(counts)
        entry = Entry(counts.record, history, why)
        (standing.unranked if why else standing.ranked).append(entry)
    newest = history[0]
    if not newest.official:
        why = "not official: its sandbox lacked a layer, or there was none"
        first = UNATTESTED if newest.record.official else why
        standing.unofficial.append(Entry(newest.record, history, (first, *reasons(newest))))


def reasons(event: Event) -> tuple[str, ...]:
    """Why a record is not ranked; empty if it is."""
    record, why = event.record, []
    if event.withdrawn is not None:
        why.append(f"withdrawn: {event.withdrawn}")
    failed = record.header.failed_cells
    if failed:
        cells = record.nominal.size + record.drawn.size
        first = record.header.failures[0].message.removesuffix("; the entry is not ranked.")
        cut = first if len(first) <= MAX_QUOTED else f"{first[:MAX_QUOTED]}…"
        why.append(f"{failed} of {cells} cells failed, the first: {cut}")
    safe = zip(record.lungs, record.header.safe, strict=True)
    unsafe = [lung for lung, passed in safe if not passed]
    if unsafe:
        why.append(f"did not pass the safety gate on {', '.join(unsafe)}")
    return tuple(why)


def rank(entries: Sequence[Entry], track: str) -> list[Row]:
    """Rank complete entries.

    Args:
        entries: to be ranked, in any order; all over the same draws.
        track: that they are on.

    Returns:
        Best first; entries of equal score by name.
    """
    ordered = sorted(entries, key=lambda e: (_rounded(e.record.ranked_values), e.record.name))
    if not ordered:
        return []
    records = [entry.record for entry in ordered]
    ranges = ranges_of(records, [record.ranked_values for record in records])
    compared = _comparisons(records, baseline(records, track))
    return [_row(entry, ranges[i][0], ranges[i], compared[i]) for i, entry in enumerate(ordered)]


def _row(
    entry: Entry, rank: int | None, ranks: tuple[int, int] | None, compared: Comparison | None
) -> Row:
    record, error = entry.record, None
    if compared is not None:
        values = record.drawn.mean(axis=2).T
        error = _interval(values, _resampled(record, values))
    nominal = float(record.nominal.mean())
    return Row(entry, rank, ranks, compared, error, nominal, worst(record))


def _comparisons(records: Sequence[Record], base: int | None) -> list[Comparison]:
    """Compare entries in the order of their ranks."""
    values = [record.ranked_values for record in records]
    means = [_resampled(*pair) for pair in zip(records, values, strict=True)]
    compared = []
    for i, own in enumerate(values):
        to_baseline = to_above = None
        if base is not None and base != i:
            to_baseline = _interval(own - values[base], means[i] - means[base])
        if i:
            to_above = _interval(own - values[i - 1], means[i] - means[i - 1])
        compared.append(Comparison(_interval(own, means[i]), to_baseline, to_above))
    return compared


def ranges_of(records: Sequence[Record], values: Sequence[Floats]) -> list[tuple[int, int]]:
    """Ranks that records may have by values of shape ``(L, K)``; see :func:`rank_ranges`."""
    if not records:
        return []
    return rank_ranges(np.stack([_resampled(*x) for x in zip(records, values, strict=True)]))


def rank_ranges(means: Floats) -> list[tuple[int, int]]:
    """Ranks that entries may have, by paired comparison of each with each; lower is better.

    The best is 1 + the number of entries that are better beyond doubt, the worst the number of
    entries less those that are worse beyond doubt. Beyond doubt: the paired 95 % interval of the
    difference does not hold zero; no allowance is made for the number of pairs.

    Args:
        means: resampled alike for all entries, shape ``(N, resamples)``.
    """
    count, least = len(means), 10.0**-DECIMALS
    ranges = []
    for own in means:
        low, high = np.quantile(own - means, (0.025, 0.975), axis=1)
        ranges.append((1 + int(np.sum(low > least)), count - int(np.sum(high < -least))))
    return ranges


def unranked_rows(entries: Sequence[Entry]) -> list[Row]:
    """Rows of entries that are not ranked, by name; scores where they exist."""
    rows = []
    for entry in sorted(entries, key=lambda e: e.record.name):
        whole = np.isfinite(entry.record.by_draw).all()
        rows.append(
            _row(entry, None, None, _comparisons([entry.record], None)[0] if whole else None)
        )
    return rows


def baseline(records: Sequence[Record], track: str) -> int | None:
    """Index of the track's PID among records."""
    names = [record.name for record in records]
    return names.index(BASELINES[track]) if BASELINES[track] in names else None


def worst(record: Record) -> tuple[float, str, float]:
    """Highest mean over draws of one cell, cmH2O, with its lung and PIP; NaN if any failed."""
    cells = record.drawn.mean(axis=0)
    if not np.isfinite(cells).all():
        return np.nan, "", np.nan
    i, j = np.unravel_index(np.argmax(cells), cells.shape)
    return float(cells[i, j]), record.lungs[i], record.pips[j]


def _rounded(values: Floats) -> float:
    return round(float(np.mean(values)), DECIMALS)


def _resampled(record: Record, values: Floats) -> Floats:
    """Resampled means of values of shape ``(L, K)``: the same draws for every record."""
    return bootstrap.resampled_scores(values, record.headroom.session, record.headroom.member)


def _interval(values: Floats, means: Floats) -> Interval:
    low, high = np.quantile(means, (0.025, 0.975))
    return Interval(float(np.mean(values)), float(low), float(high))


def stress_rows(ranked: Sequence[Row]) -> list[StressRow]:
    """Entries that were run under the newest table of stressors, best first.

    Args:
        ranked: entries of a track; those of other tables of stressors are left out.
    """
    stressed = [(row, own) for row in ranked if (own := row.record.stress) is not None]
    newest = max((own.stressors for _, own in stressed), default=0)
    current = [(row, own.tables) for row, own in stressed if own.stressors == newest]
    alike = [StressRow(row, own) for row, own in current if own.comparable(current[0][1])]
    whole = [row for row in alike if math.isfinite(row.tables.score)]
    means = [row.tables.resampled(row.tables.by_lung_and_draw) for row in whole]
    ranges = rank_ranges(np.stack(means)) if means else []
    made = []
    for row, mean, ranks in zip(whole, means, ranges, strict=True):
        low, high = np.quantile(mean, (0.025, 0.975))
        score = Interval(row.tables.score, float(low), float(high))
        made.append(replace(row, score=score, rank=ranks[0], ranks=ranks))
    made.sort(key=lambda row: (row.tables.score, row.name))
    return made + [row for row in alike if not math.isfinite(row.tables.score)]


def hardware_rows(
    records: Sequence[AnyRecord], attested: Container[str], track: Track
) -> list[HardwareRow]:
    """Rows of a track's hardware records, newest first.

    Args:
        records: all records, each after those that it names.
        attested: hashes of the records that somebody vouches for.
        track: the simulated ranking.
    """
    withdrawn = _withdrawn(records)
    simulated = {row.record.name: row for _, row in reversed(track.rows)}
    made: list[HardwareRow] = []
    seen: set[tuple[str, bool]] = set()
    for record in reversed(records):
        if not isinstance(record, HardwareRecord) or record.track != track.name:
            continue
        vouched, why = record.sha256 in attested, withdrawn.get(record.sha256)
        # Nobody takes a vouched-for record's place by one that nobody vouches for.
        key = (record.name, record.emulated)
        newest = why is None and key not in seen
        if newest and vouched:
            seen.add(key)
        row = simulated.get(record.name)
        nominal = _nominal(record, row)
        made.append(HardwareRow(record, why, vouched, newest, row, nominal))
    return [_hardware_rank(row, made) for row in made]


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


def _hardware_rank(row: HardwareRow, all_rows: Sequence[HardwareRow]) -> HardwareRow:
    own = row.comparable
    if own is None:
        return row
    scores = [round(x.record.score, _MEASURED_DECIMALS) for x in all_rows if x.comparable == own]
    mine = round(row.record.score, _MEASURED_DECIMALS)
    return replace(row, rank=1 + sum(score < mine for score in scores), count=len(scores))
