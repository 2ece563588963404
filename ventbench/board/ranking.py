"""From records to boards: which record of an entry counts, its rank, intervals and differences.

The ranked score of an entry is the mean over the draws of its mean error over all lungs and PIPs in
version 1, and of its normalised score in version 2. The draws are common to all entries and
resampled alike, so that every interval of a difference is a paired one, and ranks can be counted
within each resample. In version 2 rigs and members of the ensemble are resampled too.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ventbench.board.record import AnyRecord, Record, Sealed, Withdrawal
from ventbench.metrics import bootstrap
from ventbench.submissions.manifest import TRACKS

Floats = NDArray[np.float64]

#: The PID that each track's entries are compared with.
BASELINES = {"performance": "pid_best", "robustness": "pid_robust"}

#: Decimals, of cmH2O, that decide: replays agree to so many, so that no machine decides a tie.
DECIMALS = 9

#: Most characters of a failure's message that a reason quotes; a submission chose them.
MAX_QUOTED = 300


@dataclass(frozen=True)
class Event:
    """One record of an entry's history.

    Attributes:
        record: the record.
        withdrawn: why it was taken back; None if it was not.
        attested: whether it is signed or accepted; see :mod:`ventbench.board.attestation`.
        breach: why it does not count by the rules of its season; empty if it does.
    """

    record: Record
    withdrawn: str | None
    attested: bool
    breach: str = ""

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


@dataclass(frozen=True)
class SealedEntry:
    """A submission on hidden draws, whose rank is not known before the season's seed is.

    Attributes:
        record: the newest sealed record of the season, track and name.
        official: whether it will be ranked if it is complete and safe.
        reasons: why it is not official, or not ranked.
    """

    record: Sealed
    official: bool
    reasons: tuple[str, ...]


@dataclass
class Standing:
    """One track of one version of the board.

    Attributes:
        ranked: official, complete and safe entries, in no order yet.
        unranked: official entries that are not ranked, with reasons.
        unofficial: newest unofficial record of each submission without a newer official one.
        sealed: newest sealed record of each submission in each season that is not revealed yet.
    """

    ranked: list[Entry] = field(default_factory=list)
    unranked: list[Entry] = field(default_factory=list)
    unofficial: list[Entry] = field(default_factory=list)
    sealed: list[SealedEntry] = field(default_factory=list)


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
        rank: from 1; None if it is not ranked. See :func:`places`.
        ranks: ranks that it may have: in version 1 the 95 % interval over resamples, in version 2
            by :func:`rank_ranges`; None if it is not ranked.
        score: mean over draws, cmH2O; None if a cell failed.
        to_baseline: difference to the track's PID; None for the PID itself, or without one.
        to_above: difference to the entry above; None for the first.
        nominal: nominal score, cmH2O; NaN if a cell failed.
        worst: highest mean over draws of one cell, cmH2O, its lung and PIP; NaN if one failed.
        normalised: the normalised score, by which version 2 ranks; None in version 1, and if a
            cell failed.
    """

    entry: Entry
    rank: int | None
    ranks: tuple[int, int] | None
    score: Interval | None
    to_baseline: Interval | None
    to_above: Interval | None
    nominal: float
    worst: tuple[float, str, float]
    normalised: Comparison | None = None

    @property
    def record(self) -> Record:
        """The record that counts."""
        return self.entry.record


@dataclass(frozen=True)
class Track:
    """One track of one version.

    Attributes:
        version: of the protocol.
        name: ``"performance"`` or ``"robustness"``.
        ranked: best first.
        unranked: official entries that are not ranked, with reasons, by name.
        unofficial: entries that nobody vouches for, or without a full sandbox, by name.
        baseline: record of the track's PID, that the others are compared with; None if there is no
            ranked one.
        sealed: entries on hidden draws, by season and name.
    """

    version: int
    name: str
    ranked: tuple[Row, ...]
    unranked: tuple[Row, ...]
    unofficial: tuple[Row, ...]
    baseline: Record | None
    sealed: tuple[SealedEntry, ...] = ()

    @property
    def rows(self) -> list[tuple[str, Row]]:
        """All rows with their status, in the order in which they are shown."""
        kinds = ("ranked", "not ranked", "not official")
        groups = (self.ranked, self.unranked, self.unofficial)
        return [(kind, row) for kind, rows in zip(kinds, groups, strict=True) for row in rows]


def boards(
    records: Sequence[AnyRecord],
    attested: Container[str],
    breaches: Mapping[str, str] | None = None,
) -> dict[int, tuple[Track, ...]]:
    """Rank all records.

    Args:
        records: in the order of the chain.
        attested: hashes of the records that are signed or accepted.
        breaches: why records of seasons do not count, by their hashes.

    Returns:
        Tracks by version, newest version first.
    """
    by_version = standings(records, attested, breaches)
    return {
        version: tuple(_track(version, *track) for track in by_version[version].items())
        for version in sorted(by_version, reverse=True)
    }


def empty(version: int) -> tuple[Track, ...]:
    """Tracks of a version without a record."""
    return tuple(_track(version, name, Standing()) for name in TRACKS)


def _track(version: int, name: str, standing: Standing) -> Track:
    ranked = rank(standing.ranked, name)
    records = [row.record for row in ranked]
    base = baseline(records, name)
    return Track(
        version=version,
        name=name,
        ranked=tuple(ranked),
        unranked=tuple(unranked_rows(standing.unranked)),
        unofficial=tuple(unranked_rows(standing.unofficial)),
        baseline=None if base is None else records[base],
        sealed=tuple(sorted(standing.sealed, key=lambda entry: entry.record.key)),
    )


def standings(
    records: Sequence[AnyRecord],
    attested: Container[str],
    breaches: Mapping[str, str] | None = None,
) -> dict[int, dict[str, Standing]]:
    """Sort records into boards.

    Args:
        records: in the order of the chain: later is newer, whatever their clocks said.
        attested: hashes of the records that are signed or accepted.
        breaches: why records of seasons do not count, by their hashes.

    Returns:
        By version of the protocol, oldest first, then by track.
    """
    against = breaches or {}
    withdrawn = {w.withdraws: w.reason for w in records if isinstance(w, Withdrawal)}
    of_seasons = {entry.content.record: entry for entry in records if isinstance(entry, Sealed)}
    for inside, sealed in of_seasons.items():
        if sealed.sha256 in withdrawn:
            withdrawn[inside] = withdrawn[sealed.sha256]
    grouped: dict[tuple[int, str, str], list[Event]] = defaultdict(list)
    season = _seasons_shown(records, attested, of_seasons)
    for record in records:
        # Only records over the same draws can be compared.
        if isinstance(record, Record) and record.header.draws.season == season[record.version]:
            sha256 = record.sha256
            breach = against.get(sha256, "")
            event = Event(record, withdrawn.get(sha256), sha256 in attested, breach)
            grouped[record.version, record.track, record.name].insert(0, event)
    boards: dict[int, dict[str, Standing]] = {}
    for (version, track, _), history in sorted(grouped.items(), key=lambda group: group[0]):
        tracks = boards.setdefault(version, {name: Standing() for name in TRACKS})
        _place(tracks[track], tuple(history))
    opened = {record.sha256 for record in records if isinstance(record, Record)}
    newest = {x.key: x for x in of_seasons.values() if x.content.record not in opened}
    for sealed in newest.values():
        tracks = boards.setdefault(sealed.version, {name: Standing() for name in TRACKS})
        event = (withdrawn.get(sealed.sha256), sealed.sha256 in attested)
        tracks[sealed.track].sealed.append(_sealed(sealed, *event, against.get(sealed.sha256, "")))
    return boards


def _seasons_shown(
    records: Sequence[AnyRecord], attested: Container[str], of_seasons: Container[str]
) -> dict[int, str | None]:
    """Season whose records a version's board shows.

    The newest hidden one with an official record; without any, that of the newest official record,
    and else of the newest. So nobody clears a board by a record that nobody vouches for.

    Args:
        records: in the order of the chain.
        attested: hashes of the records that are signed or accepted.
        of_seasons: hashes of the records that were sealed once.

    Returns:
        By version.
    """
    shown: dict[int, tuple[tuple[bool, bool], str | None]] = {}
    for record in records:
        if not isinstance(record, Record):
            continue
        official = record.official and record.sha256 in attested
        standing = (official and record.sha256 in of_seasons, official)
        if standing >= shown.get(record.version, (standing, None))[0]:
            shown[record.version] = standing, record.header.draws.season
    return {version: season for version, (_, season) in shown.items()}


def _sealed(record: Sealed, withdrawn: str | None, attested: bool, breach: str) -> SealedEntry:
    official = record.official and attested and not breach
    why = [] if official else [_why_not_official(record.official, breach)]
    if withdrawn is not None:
        why.append(f"withdrawn: {withdrawn}")
    if not record.content.complete:
        why.append("a cell failed; its message is sealed")
    if not record.content.safe:
        why.append("did not pass the safety gate")
    return SealedEntry(record, official, tuple(why))


def _place(standing: Standing, history: tuple[Event, ...]) -> None:
    counts = next((event for event in history if event.official), None)
    if counts is not None:
        why = reasons(counts)
        entry = Entry(counts.record, history, why)
        (standing.unranked if why else standing.ranked).append(entry)
    newest = history[0]
    if not newest.official:
        why = (_why_not_official(newest.record.official, newest.breach), *reasons(newest))
        standing.unofficial.append(Entry(newest.record, history, why))


def _why_not_official(sandboxed: bool, breach: str) -> str:
    if breach:
        return breach
    if not sandboxed:
        return "not official: its sandbox lacked a layer, or there was none"
    return "not official: no key of this leaderboard has signed the record"


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
    ordered = sorted(entries, key=lambda e: (_key(e.record), e.record.name))
    if not ordered:
        return []
    records = [entry.record for entry in ordered]
    ranked = [record.ranked_values for record in records]
    means = _resampled(records, ranked)
    taken = places(records, ranked)
    ranges = _rank_intervals(means) if records[0].headroom is None else rank_ranges(means)
    base = baseline(records, track)
    errors = _comparisons(records, [record.drawn.mean(axis=2).T for record in records], base)
    scaled: list[Comparison | None] = [None] * len(records)
    if records[0].headroom is not None:
        scaled = list(_comparisons(records, ranked, base))
    return [
        Row(
            entry=entry,
            rank=taken[i],
            ranks=ranges[i],
            score=errors[i].score,
            to_baseline=errors[i].to_baseline,
            to_above=errors[i].to_above,
            nominal=float(entry.record.nominal.mean()),
            worst=worst(entry.record),
            normalised=scaled[i],
        )
        for i, entry in enumerate(ordered)
    ]


def _comparisons(
    records: Sequence[Record], values: Sequence[Floats], base: int | None
) -> list[Comparison]:
    """Compare entries, in the order of their ranks, by values of shape ``(L, K)``."""
    means = _resampled(records, values)
    compared = []
    for i, own in enumerate(values):
        to_baseline = to_above = None
        if base is not None and base != i:
            to_baseline = _interval(own - values[base], means[i] - means[base])
        if i:
            to_above = _interval(own - values[i - 1], means[i] - means[i - 1])
        compared.append(Comparison(_interval(own, means[i]), to_baseline, to_above))
    return compared


def places(records: Sequence[Record], values: Sequence[Floats]) -> list[int]:
    """Rank records of one version by values of shape ``(L, K)``; lower is better.

    In version 1 equal means share a rank. In version 2 the rank is one more than the number of
    entries that are better beyond doubt; see :func:`rank_ranges`.
    """
    if records and records[0].headroom is not None:
        return [best for best, _ in rank_ranges(_resampled(records, values))]
    keys = np.array([_rounded(own) for own in values])
    return [1 + int(np.sum(keys < key)) for key in keys]


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
        record = entry.record
        score = scaled = None
        if np.isfinite(record.by_draw).all():
            score = _comparisons([record], [record.drawn.mean(axis=2).T], None)[0].score
            if record.headroom is not None:
                scaled = _comparisons([record], [record.ranked_values], None)[0]
        nominal = float(record.nominal.mean())
        rows.append(Row(entry, None, None, score, None, None, nominal, worst(record), scaled))
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


def _key(record: Record) -> float:
    return _rounded(record.ranked_values)


def _rounded(values: Floats) -> float:
    return round(float(np.mean(values)), DECIMALS)


def _resampled(records: Sequence[Record], values: Sequence[Floats]) -> Floats:
    """Resampled means of each, shape ``(N, RESAMPLES)``: the same draws in each column."""
    rows = []
    for record, own in zip(records, values, strict=True):
        if record.headroom is None:
            rows.append(bootstrap.resampled_means(own.mean(axis=0)))
        else:
            session, member = record.headroom.session, record.headroom.member
            rows.append(bootstrap.resampled_scores(own, session, member))
    return np.stack(rows)


def _interval(values: Floats, means: Floats) -> Interval:
    low, high = np.quantile(means, (0.025, 0.975))
    return Interval(float(np.mean(values)), float(low), float(high))


def _rank_intervals(means: Floats) -> list[tuple[int, int]]:
    """95 % intervals of ranks that are counted within each resample."""
    rounded = np.round(means, DECIMALS)
    ranks = np.empty(means.shape, np.int64)
    for column in range(means.shape[1]):
        values = rounded[:, column]
        ranks[:, column] = 1 + np.searchsorted(np.sort(values), values, side="left")
    low = np.quantile(ranks, 0.025, axis=1, method="lower")
    high = np.quantile(ranks, 0.975, axis=1, method="higher")
    return list(zip(low.astype(int).tolist(), high.astype(int).tolist(), strict=True))
