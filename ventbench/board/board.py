"""From records to boards: each version's two tracks, ranked; what CSV, pages and terminal show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ventbench.board import ranking, standing, table
from ventbench.board.ranking import Row
from ventbench.board.record import Record, Withdrawal
from ventbench.submissions.manifest import TRACKS


@dataclass(frozen=True)
class Track:
    """One track of one version.

    Attributes:
        version: of the protocol.
        name: ``"performance"`` or ``"robustness"``.
        ranked: best first.
        unranked: official, with reasons, by name.
        unofficial: likewise; they may have no reason but that they are not official.
        baseline: record of the track's PID, that the others are compared with; None if there is no
            ranked one.
    """

    version: int
    name: str
    ranked: tuple[Row, ...]
    unranked: tuple[Row, ...]
    unofficial: tuple[Row, ...]
    baseline: Record | None

    @property
    def rows(self) -> list[tuple[str, Row]]:
        """All rows with their status, in the order in which they are shown."""
        kinds = ("ranked", "not ranked", "not official")
        groups = (self.ranked, self.unranked, self.unofficial)
        return [(kind, row) for kind, rows in zip(kinds, groups, strict=True) for row in rows]


def boards(records: Sequence[Record | Withdrawal]) -> dict[int, tuple[Track, ...]]:
    """Rank all records.

    Args:
        records: in the order of the chain.

    Returns:
        Tracks by version, newest version first.
    """
    found = standing.standings(records)
    return {
        version: tuple(_track(version, name, one) for name, one in found[version].items())
        for version in sorted(found, reverse=True)
    }


def empty(version: int) -> tuple[Track, ...]:
    """Tracks of a version without a record."""
    return tuple(_track(version, name, standing.Standing()) for name in TRACKS)


def csv_text(boards: dict[int, tuple[Track, ...]]) -> str:
    """Text of ``leaderboard.csv``."""
    tracks = [track for version in boards.values() for track in version]
    return table.text(
        table.row(track.version, track.name, status, row)
        for track in tracks
        for status, row in track.rows
    )


def _track(version: int, name: str, found: standing.Standing) -> Track:
    ranked = ranking.rank(found.ranked, name)
    records = [row.record for row in ranked]
    base = ranking.baseline(records, name)
    return Track(
        version=version,
        name=name,
        ranked=tuple(ranked),
        unranked=tuple(ranking.beside(found.unranked)),
        unofficial=tuple(ranking.beside(found.unofficial)),
        baseline=None if base is None else records[base],
    )
