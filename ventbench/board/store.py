"""The folder of a leaderboard: records, their commands and the chain; reading and adding."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ventbench import files, protocol
from ventbench.board import canonical, chain, commands, compare, fit, record
from ventbench.board.record import Record, Withdrawal
from ventbench.board.replay import replay
from ventbench.board.replayed import Simulators
from ventbench.errors import InputError

#: Folder of records and commands within the leaderboard's.
RECORDS = "records"


@dataclass(frozen=True)
class Store:
    """All records of a leaderboard, in the order of the chain.

    Attributes:
        folder: of the leaderboard.
        links: lines of the chain.
        records: one for each line.
    """

    folder: Path
    links: tuple[chain.Link, ...]
    records: tuple[Record | Withdrawal, ...]

    @property
    def head(self) -> str:
        """SHA-256 that stands for all records and their order."""
        return chain.head(self.links)

    @property
    def scores(self) -> list[Record]:
        """Records of scores only."""
        return [item for item in self.records if isinstance(item, Record)]


def single(store: Store, sha256: str) -> Record:
    """Find the record of a score by its hash, or by the unique beginning of one.

    Raises:
        InputError: if none or several begin so.
    """
    found = [item for item in store.scores if item.sha256.startswith(sha256)]
    if len(found) != 1:
        raise InputError(f"{store.folder} holds no single record that begins with {sha256!r}")
    return found[0]


def load(folder: Path) -> Store:
    """Read a leaderboard; every record is checked against its hash.

    Raises:
        InputError: naming the file that is missing or was changed.
        OSError: if one cannot be read.
    """
    links = read_chain(folder)
    return Store(folder, tuple(links), tuple(read_record(folder, link) for link in links))


def read_chain(folder: Path) -> list[chain.Link]:
    """Read the chain; empty where there is no leaderboard yet.

    Raises:
        InputError: if it was changed.
    """
    path = folder / chain.FILE
    return chain.parse(path.read_bytes(), str(path)) if path.exists() else []


def read_record(folder: Path, link: chain.Link, *, strict: bool = False) -> Record | Withdrawal:
    """Read the record that a line of the chain names.

    Args:
        folder: of the leaderboard.
        link: the line.
        strict: also check the canonical form again.

    Raises:
        InputError: if it is missing or was changed.
    """
    path = folder / RECORDS / f"{link.record}{record.SUFFIX}"
    if not path.is_file() or path.is_symlink():
        raise InputError(f"{path} is missing, but {chain.FILE} names it")
    content = path.read_bytes()
    found = canonical.digest(content)
    if found != link.record:
        raise InputError(f"{path} has been changed: its SHA-256 is {found}{_why(content)}")
    # Its canonical form was checked when it was added, and no byte has changed since.
    item = record.from_bytes(content, str(path), strict=strict)
    named = item.content["actions"]["sha256"] if isinstance(item, Record) else None
    if named != link.actions:
        raise InputError(f"{path} names other commands than {chain.FILE} line {link.index + 1}")
    return item


def _why(content: bytes) -> str:
    """What is wrong inside a changed record, where that can be seen."""
    for strict in (False, True):
        try:
            record.from_bytes(content, "the file", strict=strict)
        except InputError as error:
            return f"; {error}"
    return ""


def add(folder: Path, path: Path, simulators: Simulators | None = None) -> Record:
    """Add a record to a leaderboard.

    Args:
        folder: of the leaderboard; made if missing.
        path: of the record; its action file lies beside it.
        simulators: to replay it on first; not replayed if not given.

    Returns:
        The record.

    Raises:
        InputError: if it is not a record, does not replay, or does not fit those that are there.
        OSError: if a file cannot be read or written.
    """
    store, item = load(folder), record.load(path)
    if not isinstance(item, Record):
        raise InputError(f"{path} is a withdrawal; use ventbench board withdraw")
    if item.version != protocol.VERSION:
        raise InputError(
            f"{path} is of protocol version {item.version}; this ventbench scores and replays "
            f"version {protocol.VERSION}"
        )
    requested = commands.load(item, path.parent)
    problems = fit.problems([*store.records, item], start=len(store.records))
    if problems:
        raise InputError(f"{path}: {'; '.join(problems)}")
    if simulators is not None:
        # Through JSON: tuples become lists.
        about = canonical.parse(canonical.canonical(simulators.about()), "the simulators")
        if item.content["simulators"] != about:
            raise InputError(f"{path} was scored on other simulators than those of this ventbench")
        (found,) = replay(simulators, item.pips, [requested])
        problems = compare.differences(item, found)
        if problems:
            raise InputError(f"{path} does not replay: {'; '.join(problems)}")
    kept = commands.path_of(item, folder / RECORDS)
    content = commands.path_of(item, path.parent).read_bytes()
    files.write_atomically(kept, lambda file: file.write(content))
    _append(store, item, path.read_bytes())
    return item


def withdraw(folder: Path, sha256: str, reason: str) -> Withdrawal:
    """Take a record back; it stays in the history, its entry is no longer ranked.

    Args:
        folder: of the leaderboard.
        sha256: of the record, or the unique beginning of it.
        reason: for the page.

    Raises:
        InputError: if there is no such record, no reason, or it was withdrawn before.
    """
    store = load(folder)
    found = single(store, sha256)
    if any(isinstance(x, Withdrawal) and x.withdraws == found.sha256 for x in store.records):
        raise InputError(f"record {found.sha256[:12]} is withdrawn already")
    content = record.withdrawal(found.sha256, reason)
    item = record.from_bytes(content, "the withdrawal")
    assert isinstance(item, Withdrawal)
    _append(store, item, content)
    return item


def _append(store: Store, item: Record | Withdrawal, content: bytes) -> None:
    """Write the record, then the chain: a crash between leaves a file that nothing names."""
    path = store.folder / RECORDS / f"{item.sha256}{record.SUFFIX}"
    files.write_atomically(path, lambda file: file.write(content))
    path = store.folder / chain.FILE
    before = path.read_bytes() if path.exists() else b""
    lines = before + chain.line(len(store.links), item, store.head)
    files.write_atomically(path, lambda file: file.write(lines))
