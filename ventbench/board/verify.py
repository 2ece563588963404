"""Everything again: chain, hashes, replay of all commands, and a rebuild of every page.

Nothing stops at the first problem: each names its file, and the key, line or byte in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ventbench.board import actions, build, chain, fit, record, store
from ventbench.board.record import Record, Withdrawal
from ventbench.board.replay_check import Load, Progress, Report, check_replay
from ventbench.errors import InputError


def verify(
    folder: Path, load: Load, *, head: str | None = None, progress: Progress | None = None
) -> Report:
    """Verify a leaderboard.

    Args:
        folder: of the leaderboard.
        load: of the frozen simulators, by their version; raises InputError where they were changed.
        head: of the chain, noted earlier: it must still be on it.
        progress: called after each batch of records.

    Raises:
        InputError: if there is no leaderboard, or jinja2 is not installed.
        OSError: if a file cannot be read.
    """
    report = Report()
    if not (folder / chain.FILE).is_file():
        raise InputError(f"{folder} holds no leaderboard: {chain.FILE} is missing")
    try:
        links = store.read_chain(folder)
    except InputError as error:
        report.problems.append(str(error))
        links = []
    report.head = chain.head(links)
    if head is not None and head not in {chain.START, *(link.sha256 for link in links)}:
        report.problems.append(f"{folder / chain.FILE} does not hold the line {head}")
    items = _read(folder, links, report)
    report.records = len(items)
    if links:
        report.problems += _strangers(folder, links)
    report.problems += fit.problems(items)
    check_replay(folder, [x for x in items if isinstance(x, Record)], load, report, progress)
    if len(items) == len(links) > 0:
        report.problems += _rebuild(folder, store.Store(folder, tuple(links), tuple(items)))
    return report


def _read(folder: Path, links: Sequence[chain.Link], report: Report) -> list[Record | Withdrawal]:
    """Records that are as the chain names them; the others become problems."""
    items = []
    for link in links:
        try:
            items.append(store.read_record(folder, link, strict=True))
        except (InputError, OSError) as error:
            report.problems.append(str(error))
    return items


def _strangers(folder: Path, links: Sequence[chain.Link]) -> list[str]:
    """Files among the records that no line names."""
    named = {f"{link.record}{record.SUFFIX}" for link in links}
    named |= {f"{link.actions}{actions.SUFFIX}" for link in links}
    found = sorted(path.name for path in (folder / store.RECORDS).iterdir())
    return [
        f"{folder / store.RECORDS / name} is not named by {chain.FILE}; add it, or remove it"
        for name in found
        if name not in named
    ]


def _rebuild(folder: Path, found: store.Store) -> list[str]:
    """Built files that are missing, stale or changed, with the first byte that differs."""
    made, there = build.content(found), build.present(folder)
    problems = [f"{folder / name} is missing; run `ventbench board build`" for name in
                sorted(made.keys() - there)]  # fmt: skip
    problems += [f"{folder / name} belongs to no record" for name in sorted(there - made.keys())]
    for name in sorted(made.keys() & there):
        now = (folder / name).read_bytes()
        if now != made[name]:
            problems.append(
                f"{folder / name} is not what the records give: byte {_differs(now, made[name])}"
            )
    return problems


def _differs(a: bytes, b: bytes) -> int:
    """Index of the first byte that differs, or the length of the shorter one."""
    return next(
        (i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b))
    )
