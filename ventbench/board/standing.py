"""Which record of an entry counts, and why one is listed but not ranked."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

from ventbench.board.record import Record, Withdrawal
from ventbench.submissions.manifest import TRACKS

#: Most characters of a failure's message that a reason quotes; a submission chose them.
MOST_WORDS = 300


@dataclass(frozen=True)
class Event:
    """One record of an entry's history.

    Attributes:
        record: the record.
        withdrawn: why it was taken back; None if it was not.
    """

    record: Record
    withdrawn: str | None


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
    """One track of one version of the board.

    Attributes:
        ranked: official, complete and safe; in no order yet.
        unranked: official, with reasons.
        unofficial: newest unofficial record of a submission without a newer official one.
    """

    ranked: list[Entry] = field(default_factory=list)
    unranked: list[Entry] = field(default_factory=list)
    unofficial: list[Entry] = field(default_factory=list)


def standings(records: Sequence[Record | Withdrawal]) -> dict[int, dict[str, Standing]]:
    """Sort records into boards.

    Args:
        records: in the order of the chain: later is newer, whatever their clocks said.

    Returns:
        By version of the protocol, oldest first, then by track.
    """
    withdrawn = {x.withdraws: x.reason for x in records if isinstance(x, Withdrawal)}
    grouped: dict[tuple[int, str, str], list[Event]] = defaultdict(list)
    for item in records:
        if isinstance(item, Record):
            event = Event(item, withdrawn.get(item.sha256))
            grouped[item.version, item.track, item.name].insert(0, event)
    boards: dict[int, dict[str, Standing]] = {}
    for (version, track, _), history in sorted(grouped.items(), key=lambda group: group[0]):
        tracks = boards.setdefault(version, {name: Standing() for name in TRACKS})
        _place(tracks[track], tuple(history))
    return boards


def _place(standing: Standing, history: tuple[Event, ...]) -> None:
    counts = next((event for event in history if event.record.official), None)
    if counts is not None:
        why = reasons(counts)
        entry = Entry(counts.record, history, why)
        (standing.unranked if why else standing.ranked).append(entry)
    newest = history[0]
    if not newest.record.official:
        standing.unofficial.append(Entry(newest.record, history, reasons(newest)))


def reasons(event: Event) -> tuple[str, ...]:
    """Why a record is not ranked; empty if it is."""
    item, found = event.record, []
    if event.withdrawn is not None:
        found.append(f"withdrawn: {event.withdrawn}")
    failed = item.content["failed_cells"]
    if failed:
        cells = item.nominal.size + item.drawn.size
        first = item.content["failures"][0]["message"].removesuffix("; the entry is not ranked.")
        cut = first if len(first) <= MOST_WORDS else f"{first[:MOST_WORDS]}…"
        found.append(f"{failed} of {cells} cells failed, the first: {cut}")
    safe = zip(item.lungs, item.content["safe"], strict=True)
    unsafe = [lung for lung, passed in safe if not passed]
    if unsafe:
        found.append(f"did not pass the safety gate on {', '.join(unsafe)}")
    return tuple(found)
