"""All records against what their commands give: the part of a verification that takes time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ventbench import draws, protocol
from ventbench.board import canonical, chain, commands, compare, record, store
from ventbench.board.record import Record
from ventbench.board.replay import BATCH, replay
from ventbench.board.replayed import Simulators
from ventbench.errors import InputError

#: Loads the frozen simulators of a version.
Load = Callable[[int], Simulators]

#: Told how many records of how many have been replayed.
Progress = Callable[[int, int], None]


@dataclass
class Report:
    """What a verification found.

    Attributes:
        head: SHA-256 that stands for all records and their order.
        records: how many there are.
        replayed: how many were replayed.
        deviation: largest difference between a recorded error and its replay, cmH2O.
        problems: one sentence each; empty if all is well.
        notes: what could not be looked at, which is no problem.
    """

    head: str = chain.START
    records: int = 0
    replayed: int = 0
    deviation: float = 0.0
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def check_replay(
    folder: Path,
    items: Sequence[Record],
    load: Load,
    report: Report,
    progress: Progress | None,
) -> None:
    """Replay records and note in the report what differs.

    Args:
        folder: of the leaderboard.
        items: records of scores.
        load: of the frozen simulators, by their version.
        report: written to.
        progress: called after each batch.
    """
    for about, group in _groups(items, report).items():
        simulators = _simulators(about, load, report)
        if simulators is None:
            continue
        for first in range(0, len(group), BATCH):
            _replay_batch(folder, group[first : first + BATCH], simulators, report)
            if progress is not None:
                progress(min(first + BATCH, len(group)), len(group))


def _groups(items: Sequence[Record], report: Report) -> dict[str, list[Record]]:
    """Records that can be replayed together, by canonical text of their simulators."""
    groups: dict[str, list[Record]] = {}
    old: set[int] = set()
    for item in items:
        if item.version > protocol.VERSION:
            report.problems.append(
                f"record {item.sha256}, key protocol: version {item.version} is not known to this "
                "ventbench"
            )
        elif item.version < protocol.VERSION:
            old.add(item.version)
        elif item.content["draws"] != draws.about():
            report.problems.append(f"record {item.sha256}, key draws: not the published draws")
        else:
            groups.setdefault(item.basis[0], []).append(item)
    report.notes += [
        f"records of protocol version {version} were not replayed; an older ventbench does that"
        for version in sorted(old)
    ]
    return groups


def _simulators(about: str, load: Load, report: Report) -> Simulators | None:
    """Load the simulators that records name; None, and a problem, where they cannot be had."""
    named: Mapping[str, Any] = canonical.parse_any(about.encode(), "simulators")
    version = named.get("version")
    if not isinstance(version, int):  # it becomes part of a path
        report.problems.append(f"simulators: a record names version {version!r}, not a number")
        return None
    try:
        simulators = load(version)
        # Through JSON: tuples become lists.
        here = canonical.parse_any(canonical.canonical(simulators.about()), "simulators")
    # A damaged manifest can lack anything; InputError is a ValueError.
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        text = str(error) if isinstance(error, InputError) else repr(error)
        report.problems.append(f"simulators: {text}")
        return None
    if here == named:
        return simulators
    keys = sorted(k for k in {*here, *named} if here.get(k) != named.get(k))
    report.problems.append(
        f"simulators: those of this ventbench are not those of the records; {', '.join(keys)} "
        "differ"
    )
    return None


def _replay_batch(
    folder: Path, batch: Sequence[Record], simulators: Simulators, report: Report
) -> None:
    sound, requested = [], []
    for item in batch:
        try:
            requested.append(commands.load(item, folder / store.RECORDS))
            sound.append(item)
        except (InputError, OSError) as error:
            report.problems.append(str(error))
    if not sound:
        return
    for item, found in zip(sound, replay(simulators, sound[0].pips, requested), strict=True):
        report.replayed += 1
        report.deviation = max(report.deviation, compare.deviation(item, found))
        path = folder / store.RECORDS / f"{item.sha256}{record.SUFFIX}"
        report.problems += [f"{path}, {text}" for text in compare.differences(item, found)]
