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
from functools import cached_property
from typing import Any

import numpy as np

from ventbench.base.arrays import Floats, Ints
from ventbench.base.interval import Interval
from ventbench.board import comparison, gate, store
from ventbench.board.canonical import RECORDS
from ventbench.board.comparison import CMH2O, POINTS
from ventbench.board.record import HardwareRecord, Record
from ventbench.board.rounds import Round, key_of
from ventbench.board.store import Store
from ventbench.entries.manifest import TRACKS
from ventbench.entries.runs import Runs
from ventbench.task import protocol
from ventbench.task.draws import DEVELOPMENT
from ventbench.task.lungs import LUNG_IDS

#: The PID that each track's entries are compared with.
BASELINES = {"performance": "pid_best", "robustness": "pid_robust"}

#: Decimals that decide: replays agree to so many, so that no machine decides a tie.
DECIMALS = 9

#: Decimals, of cmH2O, that decide a hardware rank: measured scores repeat no better.
_MEASURED_DECIMALS = 3


@dataclass(frozen=True)
class Place:
    """Where an entry stands among those that it is ranked with."""

    rank: int  #: from 1. See :mod:`ventbench.board.comparison`.
    best: int  #: best rank that it may have.
    worst: int  #: worst rank.

    @property
    def range(self) -> str:
        """Ranks that it may have, where they are several."""
        return f"{self.best} to {self.worst}" if self.best < self.worst else ""


@dataclass(frozen=True)
class Row:
    """An entry: a submission on one track and on the same draws, by the record that counts."""

    record: Record  #: the newest one: of the official ones if there are any.
    history: tuple[Record, ...]  #: all of its records, newest first.
    status: str  #: ``"ranked"``, ``"practice"``, ``"not ranked"`` or ``"not official"``.
    reasons: tuple[str, ...] = ()  #: why it is not ranked; empty if it is.
    #: ranked scores of the seeds of its training, if its round holds any.
    seeds: Sequence[float] = ()
    #: name of the earlier entry whose commands it follows; empty if there is none.
    source: str = ""
    place: Place | None = None  #: None if it is not ranked.
    stress_place: Place | None = None  #: the same under missing physics.
    #: normalised score less that of the track's PID, and of the entry above; None without one.
    to_baseline: Interval | None = None
    to_above: Interval | None = None

    @property
    def listed(self) -> bool:
        """Whether it stands in the table of its track: ranked, or would be on other draws."""
        return self.status in ("ranked", "practice")

    @cached_property
    def normalised(self) -> Interval | None:
        """The normalised score, which ranks; None if a cell failed."""
        figures = self.record.figures
        return figures.interval(figures.ranked_values)

    @cached_property
    def error(self) -> Interval | None:
        """The error of the same runs, cmH2O; None if a cell failed."""
        figures = self.record.figures
        return figures.interval(figures.drawn[figures.ranked].mean(axis=2).T)

    @cached_property
    def stress(self) -> Interval | None:
        """The stress score, cmH2O; None if a run failed, or it did not run under stress."""
        runs = self.record.figures.stressed
        if runs is None or not math.isfinite(runs.score):
            return None
        return runs.interval(runs.by_lung_and_draw)

    @property
    def worst(self) -> tuple[float, str, float]:
        """Highest mean over draws of one cell, cmH2O, its lung and PIP; NaN if one failed."""
        cells = self.record.figures.drawn.mean(axis=0)
        if not np.isfinite(cells).all():
            return np.nan, "", np.nan
        i, j = np.unravel_index(np.argmax(cells), cells.shape)
        return float(cells[i, j]), LUNG_IDS[i], protocol.PIPS[j]


def stressed_runs(row: Row) -> Runs:
    """Runs under missing physics of an entry that has some."""
    assert row.record.figures.stressed is not None
    return row.record.figures.stressed


@dataclass(frozen=True)
class HardwareRow:
    """One hardware record beside the simulated one of the same entry."""

    record: HardwareRecord  #: the hardware record.
    reasons: tuple[str, ...]  #: why it has no rank; empty if it has one.
    newest: bool  #: whether no later one of the same entry and kind of device counts instead.
    simulated: Row | None  #: row of the entry in the simulated ranking; None if there is none.
    #: among the newest records over the same lungs and PIPs, from 1; None if it has none.
    rank: int | None = None
    count: int = 0  #: how many were ranked.

    @property
    def nominal(self) -> float:
        """Nominal simulated score over the same lungs and PIPs, cmH2O; NaN without one."""
        if self.simulated is None:
            return math.nan
        lungs = [LUNG_IDS.index(lung) for lung in self.record.header.lungs]
        pips = [protocol.PIPS.index(pip) for pip in self.record.header.pips]
        return float(self.simulated.record.figures.nominal[np.ix_(lungs, pips)].mean())

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
    #: all entries: those that are listed, best first, then those that are not ranked and those
    #: that nobody vouches for or that had no full sandbox, by name.
    rows: tuple[Row, ...]
    hardware: tuple[HardwareRow, ...] = ()  #: hardware records of the track, newest first.

    @property
    def listed(self) -> list[Row]:
        """Entries of the table, best first."""
        return [row for row in self.rows if row.listed]

    @property
    def stress(self) -> list[Row]:
        """Of these who ran under the newest table of stressors, best first."""
        ran = [row for row in self.listed if row.record.figures.stressed is not None]
        return sorted(ran, key=lambda x: (x.stress.value if x.stress else math.inf, x.record.name))

    @property
    def title(self) -> str:
        """What the draws are, in words."""
        if self.round is None:
            return "practice on the development draws, not ranked"
        kind = "rehearsal" if self.round.opened.rehearsal else "round"
        return f"{kind} {self.draws}"


def board(leaderboard: Store) -> tuple[Track, ...]:
    """Rank all records: both tracks of every round, the newest first, and practice last."""
    grouped: dict[tuple[str, str], dict[str, list[Record]]] = defaultdict(dict)
    for record in (x for x in leaderboard.scores if x.derived):
        draws = record.draws if leaderboard.round_of(record) else DEVELOPMENT
        histories = grouped[draws, record.track]
        histories.setdefault(record.name, []).insert(0, record)
    tracks = [
        _track(leaderboard, draws, name, grouped[draws, name])
        for draws in (*leaderboard.seeded, DEVELOPMENT)
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
) -> Track:
    """Sort the entries of a track: listed, not ranked, not official."""
    round_ = leaderboard.seeded.get(draws)
    rows: dict[str, list[Row]] = defaultdict(list)
    for _, history in sorted(histories.items()):
        # The one that is not withdrawn; nobody takes an official one's place.
        record = min(
            history,
            key=lambda x: (x.sha256 in leaderboard.withdrawn, not gate.official(x, leaderboard)),
        )
        why = gate.simulated(record, leaderboard)
        status = "ranked"
        if round_ is None:
            status, why = "practice", tuple(x for x in why if x != gate.PRACTICE)
        status = "not ranked" if why else status
        status = status if gate.official(record, leaderboard) else "not official"
        result, key = round_ and round_.result, key_of(record.name, record.track)
        seeds: Sequence[float] = ()
        if result and result.records.get(key) == record.sha256:
            seeds = result.seeds.get(key, ())
        rows[status].append(Row(record, tuple(history), status, why, seeds))
    listed = rank(derived(leaderboard, rows["ranked"] + rows["practice"]))
    return Track(name, draws, round_, (*listed, *rows["not ranked"], *rows["not official"]))


def derived(leaderboard: Store, rows: Sequence[Row]) -> list[Row]:
    """Name the source of each entry whose commands follow those of an earlier one.

    The earlier one is that whose code was frozen first, in an earlier round or before it in the
    same, baselines before all. What a record says of its date decides nothing.
    """
    first: dict[str, int] = {}
    for round_ in reversed(leaderboard.rounds):
        for entered in round_.entries:
            first.setdefault(entered.sha256, len(first))

    def place(row: Row) -> tuple[bool, int]:
        record = row.record
        code = record.header.submission.sha256
        return record.name not in BASELINES.values(), first.get(code, len(first))

    order = sorted(rows, key=place)
    sources = comparison.sources([_commands(leaderboard, x.record) for x in order])
    return [
        row if at is None else replace(row, source=order[at].record.name)
        for row, at in zip(order, sources, strict=True)
    ]


def _commands(leaderboard: Store, record: Record) -> Floats:
    """Drawn commands of the last scored breath as applied, %, shape ``(runs, steps)``."""
    commands = store.load_commands(record.header.commands, leaderboard.folder / RECORDS)
    last = commands[:, 1:, :, max(protocol.SCORED_BREATHS)]
    return last.reshape(-1, last.shape[-1])


def rank(rows: Sequence[Row]) -> list[Row]:
    """Rank complete entries, in any order, all over the same draws of a track.

    Best first, those of equal score by name; in practice the order is all.
    """
    ordered = sorted(rows, key=lambda x: x.record.name)
    ordered.sort(key=lambda x: round(float(np.mean(x.record.figures.ranked_values)), DECIMALS))
    if not ordered:
        return []
    figures = [row.record.figures for row in ordered]
    values = [one.ranked_values for one in figures]
    places = _places(ordered, values, figures[0].rig[:, figures[0].ranked], POINTS)
    base = baseline(ordered)
    ranked = []
    for i, row in enumerate(ordered):
        to_baseline = to_above = None
        if base is not None and base is not row:
            to_baseline = figures[i].interval(values[i] - base.record.figures.ranked_values)
        if i:
            to_above = figures[i].interval(values[i] - values[i - 1])
        place = places[i] if row.status == "ranked" else None
        ranked.append(replace(row, place=place, to_baseline=to_baseline, to_above=to_above))
    return _ranked_under_stress(ranked)


def baseline(rows: Sequence[Row]) -> Row | None:
    """The track's PID among entries."""
    return next((x for x in rows if x.record.name == BASELINES[x.record.track]), None)


def _places(
    rows: Sequence[Row], values: Sequence[Floats], rig: Ints, matters: float
) -> list[Place]:
    """Places by values of lungs and draws, ``(L, k)``; see :func:`comparison.ranks`."""
    names = [row.record.name for row in rows]
    source = [names.index(x.source) if x.source in names else None for x in rows]
    computed = comparison.ranks(np.stack(values), rig, source, matters=matters)
    places = zip(computed.rank, computed.best, computed.worst, strict=True)
    return [Place(*map(int, place)) for place in places]


def _ranked_under_stress(rows: list[Row]) -> list[Row]:
    """Give places under missing physics to those who have a rank, if no run of them failed."""
    ran = {x.record.name: x for x in rows if x.place is not None and x.stress is not None}
    if not ran:
        return rows
    runs = [stressed_runs(row) for row in ran.values()]
    values = [one.by_lung_and_draw for one in runs]
    places = dict(zip(ran, _places([*ran.values()], values, runs[0].rig, CMH2O), strict=True))
    return [replace(row, stress_place=places.get(row.record.name)) for row in rows]


def _hardware_rows(leaderboard: Store, track: Track) -> tuple[HardwareRow, ...]:
    """Rows of a track's hardware records, newest first."""
    simulated = {row.record.name: row for row in reversed(track.rows)}
    rows: list[HardwareRow] = []
    vouched_entries: set[tuple[str, bool]] = set()
    for record in reversed(leaderboard.records):
        if not isinstance(record, HardwareRecord) or record.track != track.name:
            continue
        # Nobody takes a vouched-for record's place by one that nobody vouches for.
        key = (record.name, record.emulated)
        newest = record.sha256 not in leaderboard.withdrawn and key not in vouched_entries
        if newest and record.sha256 in leaderboard.attested:
            vouched_entries.add(key)
        why = gate.measured(record, leaderboard)
        rows.append(HardwareRow(record, why, newest, simulated.get(record.name)))
    return tuple(_hardware_rank(row, rows) for row in rows)


def _hardware_rank(row: HardwareRow, all_rows: Sequence[HardwareRow]) -> HardwareRow:
    comparable = row.comparable
    if comparable is None:
        return row
    scores = [
        round(x.record.score, _MEASURED_DECIMALS) for x in all_rows if x.comparable == comparable
    ]
    mine = round(row.record.score, _MEASURED_DECIMALS)
    return replace(row, rank=1 + sum(score < mine for score in scores), count=len(scores))
