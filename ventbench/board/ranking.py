"""From records to a board: which record of an entry counts, its rank, intervals and differences.

The ranked score of an entry is the mean of its normalised score over draws, lungs and PIPs of a
round. Intervals resample draws, rigs and members of the ensemble alike for all entries, so that
those of differences are paired; ranks follow from :mod:`ventbench.board.comparison`, and who may
have one from :mod:`ventbench.board.gate`. Stress ranks compare entries of the robustness track
under missing physics, hardware ranks those that ran on the same lungs and PIPs of a bench.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.base.interval import Interval
from ventbench.board import comparison, gate, store
from ventbench.board.canonical import RECORDS
from ventbench.board.comparison import CMH2O, POINTS, Ranks
from ventbench.board.gate import Evidence
from ventbench.board.record import HardwareRecord, Record
from ventbench.board.rounds import Round
from ventbench.board.store import Store
from ventbench.entries.manifest import TRACKS
from ventbench.entries.runs import Runs
from ventbench.task import protocol
from ventbench.task.draws import DEVELOPMENT
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics import bootstrap

#: The PID that each track's entries are compared with.
BASELINES = {"performance": "pid_best", "robustness": "pid_robust"}

#: Decimals that decide: replays agree to so many, so that no machine decides a tie.
DECIMALS = 9

#: Decimals, of cmH2O, that decide a hardware rank: measured scores repeat no better.
_MEASURED_DECIMALS = 3


@dataclass(frozen=True)
class Entry:
    """A submission on one track and on the same draws, by the record that counts."""

    record: Record  #: the newest one: of the official ones if there are any.
    history: tuple[Record, ...]  #: all of its records, newest first.
    reasons: tuple[str, ...]  #: why it is not ranked; empty if it is.
    #: name of the earlier entry whose commands it follows; empty if there is none.
    source: str = ""


@dataclass(frozen=True)
class Comparison:
    """A score as mean over draws, and differences to others, cmH2O or points.

    There is none to the baseline for the track's PID itself or without one, and none to the entry
    above for the first.
    """

    score: Interval
    to_baseline: Interval | None
    to_above: Interval | None


@dataclass(frozen=True)
class Row:
    """One ranked entry, or one shown beside them."""

    entry: Entry  #: whose row it is.
    rank: int | None  #: from 1; None if it is not ranked. See :mod:`ventbench.board.comparison`.
    ranks: tuple[int, int] | None  #: ranks that it may have; None if it is not ranked.
    normalised: Comparison | None  #: the normalised score, which ranks; None if a cell failed.
    error: Interval | None  #: the error of the same runs, cmH2O; None if a cell failed.
    nominal: float  #: the paper's score, cmH2O; NaN if a cell failed.
    #: highest mean over draws of one cell, cmH2O, its lung and PIP; NaN if one failed.
    worst: tuple[float, str, float]

    @property
    def record(self) -> Record:
        """The record that counts."""
        return self.entry.record


@dataclass(frozen=True)
class StressRow:
    """One entry under missing physics."""

    row: Row  #: of the entry on the robustness track.
    tables: Runs  #: its stressed runs.
    score: Interval | None = None  #: stress score with its interval, cmH2O; None if a run failed.
    rank: int | None = None  #: as of :class:`Row`; None if a run failed, or it has no rank.
    ranks: tuple[int, int] | None = None  #: ranks that it may have.

    @property
    def name(self) -> str:
        """Name of the entry."""
        return self.row.record.name


@dataclass(frozen=True)
class HardwareRow:
    """One hardware record beside the simulated one of the same entry."""

    record: HardwareRecord  #: the hardware record.
    reasons: tuple[str, ...]  #: why it has no rank; empty if it has one.
    newest: bool  #: whether no later one of the same entry and kind of device counts instead.
    simulated: Row | None  #: row of the entry in the simulated ranking; None if there is none.
    nominal: float  #: nominal simulated score over the same lungs and PIPs, cmH2O; NaN without one.
    #: among the newest records over the same lungs and PIPs, from 1; None if it has none.
    rank: int | None = None
    count: int = 0  #: how many were ranked.

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
        if self.reasons or not self.newest:
            return None
        return frozenset(self.record.header.lungs), frozenset(self.record.header.pips)


@dataclass(frozen=True)
class Track:
    """One track of a round, or of practice on the development draws."""

    name: str  #: ``"performance"`` or ``"robustness"``.
    draws: str  #: name of the draws: of the round, or ``"development"``.
    round: Round | None  #: that ranks; None for practice, where nothing is.
    ranked: tuple[Row, ...]  #: best first; in practice whatever could be ranked on other draws.
    unranked: tuple[Row, ...]  #: official entries that are not ranked, with reasons, by name.
    #: entries that nobody vouches for, or without a full sandbox, by name.
    unofficial: tuple[Row, ...]
    #: record of the track's PID, that the others are compared with; None if there is no ranked one.
    baseline: Record | None
    #: ranked entries that ran under the newest table of stressors, best first.
    stress: tuple[StressRow, ...]
    hardware: tuple[HardwareRow, ...] = ()  #: hardware records of the track, newest first.

    @property
    def rows(self) -> list[tuple[str, Row]]:
        """All rows with their status, in the order in which they are shown."""
        kinds = ("ranked" if self.round else "practice", "not ranked", "not official")
        groups = (self.ranked, self.unranked, self.unofficial)
        return [(kind, row) for kind, rows in zip(kinds, groups, strict=True) for row in rows]

    @property
    def title(self) -> str:
        """What the draws are, in words."""
        if self.round is None:
            return "practice on the development draws, not ranked"
        kind = "rehearsal" if self.round.opened.rehearsal else "round"
        return f"{kind} {self.draws}"


def board(leaderboard: Store) -> tuple[Track, ...]:
    """Rank all records: both tracks of every round, the newest first, and practice last."""
    evidence = leaderboard.evidence
    grouped: dict[tuple[str, str], dict[str, list[Record]]] = defaultdict(dict)
    for record in (x for x in leaderboard.scores if x.derived):
        season = record.header.draws.season
        histories = grouped[season if season in evidence.rounds else DEVELOPMENT, record.track]
        histories.setdefault(record.name, []).insert(0, record)
    tracks = [
        _track(leaderboard, draws, name, grouped[draws, name], evidence)
        for draws in (*evidence.rounds, DEVELOPMENT)
        for name in TRACKS
    ]
    # Hardware stands beside the newest simulated ranking.
    newest = len(TRACKS)
    return (
        *(replace(x, hardware=_hardware_rows(leaderboard, x)) for x in tracks[:newest]),
        *tracks[newest:],
    )


def newest(tracks: Sequence[Track]) -> list[Track]:
    """Tracks that the board shows first: those of the newest scored round, and practice."""
    draws = next((x.draws for x in tracks if x.round and x.round.result), None)
    return [x for x in tracks if x.draws == draws or x.round is None]


def _track(
    leaderboard: Store,
    draws: str,
    name: str,
    histories: dict[str, list[Record]],
    evidence: Evidence,
) -> Track:
    """Sort the entries of a track: ranked, not ranked, not official."""
    round_ = evidence.rounds.get(draws)
    placed: dict[str, list[Entry]] = defaultdict(list)
    for _, history in sorted(histories.items()):
        # The one that is not withdrawn; nobody takes an official one's place.
        record = min(
            history, key=lambda x: (x.sha256 in evidence.withdrawn, not evidence.official(x))
        )
        why = gate.simulated(record, evidence)
        if round_ is None:
            why = tuple(reason for reason in why if reason != gate.PRACTICE)
        kind = "unranked" if why else "ranked"
        kind = kind if evidence.official(record) else "unofficial"
        placed[kind].append(Entry(record, tuple(history), why))
    ranked = rank(derived(leaderboard, placed["ranked"]), name, ranks=round_ is not None)
    records = [row.record for row in ranked]
    base = _baseline(records, name)
    return Track(
        name=name,
        draws=draws,
        round=round_,
        ranked=tuple(ranked),
        unranked=tuple(_unranked_rows(placed["unranked"])),
        unofficial=tuple(_unranked_rows(placed["unofficial"])),
        baseline=None if base is None else records[base],
        stress=tuple(_stress_rows(ranked, evidence)),
    )


def derived(leaderboard: Store, entries: Sequence[Entry]) -> list[Entry]:
    """Name the source of each entry whose commands follow those of an earlier one.

    The earlier one is that whose code was frozen first, in an earlier round or before it in the
    same, baselines before all. What a record says of its date decides nothing.
    """
    first: dict[str, int] = {}
    for round_ in reversed(leaderboard.rounds):
        for entered in round_.entries:
            first.setdefault(entered.sha256, len(first))

    def place(entry: Entry) -> tuple[bool, int]:
        record = entry.record
        code = record.header.submission.sha256
        return record.name not in BASELINES.values(), first.get(code, len(first))

    order = sorted(entries, key=place)
    sources = comparison.sources([_commands(leaderboard, x.record) for x in order])
    return [
        entry if at is None else replace(entry, source=order[at].record.name)
        for entry, at in zip(order, sources, strict=True)
    ]


def _commands(leaderboard: Store, record: Record) -> Floats:
    """Drawn commands of the last scored breath as applied, %, shape ``(runs, steps)``."""
    commands = store.load_commands(record.header.commands, leaderboard.folder / RECORDS)
    last = commands[:, 1:, :, max(protocol.SCORED_BREATHS)]
    return last.reshape(-1, last.shape[-1])


def rank(entries: Sequence[Entry], track: str, *, ranks: bool = True) -> list[Row]:
    """Rank complete entries, in any order, all over the same draws of a track.

    Best first, those of equal score by name; without ``ranks`` the order is only practice.
    """
    ordered = sorted(entries, key=lambda e: e.record.name)
    ordered.sort(key=lambda e: round(float(np.mean(e.record.figures.ranked_values)), DECIMALS))
    if not ordered:
        return []
    records = [entry.record for entry in ordered]
    rig = records[0].figures.rig[:, records[0].figures.ranked]
    computed = _ranks(ordered, [record.figures.ranked_values for record in records], rig, POINTS)
    compared = _comparisons(records, _baseline(records, track))
    rows = []
    for i, entry in enumerate(ordered):
        may = (int(computed.best[i]), int(computed.worst[i]))
        placement = (int(computed.rank[i]), may) if ranks else (None, None)
        rows.append(_row(entry, *placement, compared[i]))
    return rows


def _ranks(entries: Sequence[Entry], values: Sequence[Floats], rig: Ints, matters: float) -> Ranks:
    """Ranks by values of lungs and draws, ``(L, k)``; see :func:`comparison.ranks`."""
    names = [entry.record.name for entry in entries]
    source = [names.index(x.source) if x.source in names else None for x in entries]
    return comparison.ranks(np.stack(values), rig, source, matters=matters)


def _row(
    entry: Entry, rank: int | None, ranks: tuple[int, int] | None, compared: Comparison | None
) -> Row:
    record, error = entry.record, None
    if compared is not None:
        values = record.figures.drawn[record.figures.ranked].mean(axis=2).T
        error = _interval(values, _resampled(record, values))
    nominal = float(record.figures.nominal.mean())
    return Row(entry, rank, ranks, compared, error, nominal, worst(record))


def _comparisons(records: Sequence[Record], base: int | None) -> list[Comparison]:
    """Compare entries in the order of their ranks."""
    values = [record.figures.ranked_values for record in records]
    means = [_resampled(*pair) for pair in zip(records, values, strict=True)]
    compared = []
    for i, scores in enumerate(values):
        to_baseline = to_above = None
        if base is not None and base != i:
            to_baseline = _interval(scores - values[base], means[i] - means[base])
        if i:
            to_above = _interval(scores - values[i - 1], means[i] - means[i - 1])
        compared.append(Comparison(_interval(scores, means[i]), to_baseline, to_above))
    return compared


def _unranked_rows(entries: Sequence[Entry]) -> list[Row]:
    """Rows of entries that are not ranked, by name; scores where they exist."""
    rows = []
    for entry in sorted(entries, key=lambda e: e.record.name):
        complete = np.isfinite(entry.record.figures.drawn).all()
        rows.append(
            _row(entry, None, None, _comparisons([entry.record], None)[0] if complete else None)
        )
    return rows


def _baseline(records: Sequence[Record], track: str) -> int | None:
    """Index of the track's PID among records."""
    names = [record.name for record in records]
    return names.index(BASELINES[track]) if BASELINES[track] in names else None


def worst(record: Record) -> tuple[float, str, float]:
    """Highest mean over draws of one cell, cmH2O, with its lung and PIP; NaN if any failed."""
    cells = record.figures.drawn.mean(axis=0)
    if not np.isfinite(cells).all():
        return np.nan, "", np.nan
    i, j = np.unravel_index(np.argmax(cells), cells.shape)
    return float(cells[i, j]), LUNG_IDS[i], protocol.PIPS[j]


def _resampled(record: Record, values: Floats) -> Floats:
    """Resampled means of values of shape ``(L, k)``: the same ranked draws for every record."""
    figures, some = record.figures, record.figures.ranked
    return bootstrap.resampled_scores(values, figures.rig[:, some], figures.member[:, some])


def _interval(values: Floats, means: Floats) -> Interval:
    return Interval(float(np.mean(values)), *bootstrap.limits(means))


def _stress_rows(rows: Sequence[Row], evidence: Evidence) -> list[StressRow]:
    """Entries that ran under the newest table of stressors, best first; others are left out."""
    ran = [(row, runs) for row in rows if (runs := row.record.figures.stressed) is not None]
    stress_rows = [StressRow(row, runs) for row, runs in ran]
    complete = [row for row in stress_rows if math.isfinite(row.tables.score)]
    if not complete:
        return stress_rows
    fit = [row for row in complete if not gate.stressed(row.row.record, evidence)]
    ranks = {}
    if fit:
        values = [row.tables.by_lung_and_draw for row in fit]
        computed = _ranks([row.row.entry for row in fit], values, fit[0].tables.rig, CMH2O)
        for i, row in enumerate(fit):
            ranks[row.name] = int(computed.rank[i]), (int(computed.best[i]), int(computed.worst[i]))
    scored = []
    for row in complete:
        low, high = row.tables.interval(row.tables.by_lung_and_draw)
        score = Interval(row.tables.score, low, high)
        place, may = ranks.get(row.name, (None, None))
        scored.append(replace(row, score=score, rank=place, ranks=may))
    scored.sort(key=lambda row: (row.tables.score, row.name))
    return scored + [row for row in stress_rows if not math.isfinite(row.tables.score)]


def _hardware_rows(leaderboard: Store, track: Track) -> tuple[HardwareRow, ...]:
    """Rows of a track's hardware records, newest first."""
    evidence = leaderboard.evidence
    simulated = {row.record.name: row for _, row in reversed(track.rows)}
    rows: list[HardwareRow] = []
    vouched_entries: set[tuple[str, bool]] = set()
    for record in reversed(leaderboard.records):
        if not isinstance(record, HardwareRecord) or record.track != track.name:
            continue
        # Nobody takes a vouched-for record's place by one that nobody vouches for.
        key = (record.name, record.emulated)
        newest = record.sha256 not in evidence.withdrawn and key not in vouched_entries
        if newest and record.sha256 in evidence.vouched:
            vouched_entries.add(key)
        row = simulated.get(record.name)
        why = gate.measured(record, evidence)
        rows.append(HardwareRow(record, why, newest, row, _nominal(record, row)))
    return tuple(_hardware_rank(row, rows) for row in rows)


def _nominal(record: HardwareRecord, row: Row | None) -> float:
    """Nominal simulated score over the lungs and PIPs of a hardware record, cmH2O."""
    if row is None:
        return math.nan
    simulated, header = row.record, record.header
    lungs = [LUNG_IDS.index(lung) for lung in header.lungs]
    pips = [protocol.PIPS.index(pip) for pip in header.pips]
    return float(simulated.figures.nominal[np.ix_(lungs, pips)].mean())


def _hardware_rank(row: HardwareRow, all_rows: Sequence[HardwareRow]) -> HardwareRow:
    comparable = row.comparable
    if comparable is None:
        return row
    scores = [
        round(x.record.score, _MEASURED_DECIMALS) for x in all_rows if x.comparable == comparable
    ]
    mine = round(row.record.score, _MEASURED_DECIMALS)
    return replace(row, rank=1 + sum(score < mine for score in scores), count=len(scores))
