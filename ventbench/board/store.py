"""The folder of a leaderboard: records, their commands, and the chain over them.

``chain.jsonl`` has one line a record in the order of arrival, each with the hash of the line
before. It makes the order and the set of records as immutable as a record itself: nothing can be
changed, swapped or left out in the middle without changing every later line, and the last line's
hash (the *head*) stands for all of them. Only the end can be cut off unseen; whoever has noted a
head can check that it is still there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ventbench import files, protocol
from ventbench.board import actions, attestation, canonical, record, schema
from ventbench.board.hardware import HardwareRecord
from ventbench.board.layout import CHAIN, RECORDS
from ventbench.board.record import AnyRecord, Record, Withdrawal
from ventbench.errors import InputError

if TYPE_CHECKING:
    from ventbench.board.replay import ReplayPlants

#: Stands for the hash of the line before the first.
CHAIN_START = "0" * 64


@dataclass(frozen=True)
class Link:
    """One line of the chain.

    Attributes:
        index: of the line, from 0.
        record: SHA-256 of the record.
        actions: SHA-256 of its action file; None for a withdrawal.
        previous: SHA-256 of the line before, newline included.
        sha256: of this line, newline included.
    """

    index: int
    record: str
    actions: str | None
    previous: str
    sha256: str


@dataclass(frozen=True)
class Store:
    """All records of a leaderboard, in the order of the chain.

    Attributes:
        folder: of the leaderboard.
        links: lines of the chain.
        records: one for each line.
        attested: hashes of the records that are signed or accepted; see
            :mod:`ventbench.board.attestation`.
    """

    folder: Path
    links: tuple[Link, ...]
    records: tuple[AnyRecord, ...]
    attested: frozenset[str]

    @property
    def head(self) -> str:
        """SHA-256 that stands for all records and their order."""
        return chain_head(self.links)

    @property
    def scores(self) -> list[Record]:
        """Records of scores only."""
        return [entry for entry in self.records if isinstance(entry, Record)]


def chain_line(index: int, added: AnyRecord, previous: str) -> bytes:
    """Return the chain's line of a record.

    Args:
        index: of the line, from 0.
        added: the record.
        previous: SHA-256 of the line before; :data:`CHAIN_START` for the first.
    """
    commands = added.header.actions.sha256 if isinstance(added, Record) else None
    return canonical.canonical(
        {"index": index, "record": added.sha256, "actions": commands, "previous": previous}
    )


def chain_head(links: Sequence[Link]) -> str:
    """SHA-256 of the last line; :data:`CHAIN_START` if there is none."""
    return links[-1].sha256 if links else CHAIN_START


def parse_chain(content: bytes, label: str = CHAIN) -> list[Link]:
    """Read and check a chain.

    Args:
        content: of the file.
        label: names it in messages.

    Raises:
        InputError: naming the first line that is wrong.
    """
    links: list[Link] = []
    seen: set[str] = set()
    for index, text in enumerate(content.splitlines(keepends=True)):
        where = f"{label} line {index + 1}"
        canonical.parse(text, where)
        line = schema.read_line(text, where)
        if line.index != index or line.previous != chain_head(links):
            raise InputError(f"{where} does not follow the line before; one of them was changed")
        if line.record in seen:
            raise InputError(f"{where} names record {line.record} again")
        seen.add(line.record)
        links.append(Link(index, line.record, line.actions, line.previous, canonical.digest(text)))
    return links


def load(folder: Path) -> Store:
    """Read a leaderboard; every record is checked against its hash and its signature.

    Raises:
        InputError: naming the file that is missing, was changed, or holds a wrong signature.
        OSError: if one cannot be read.
    """
    links = read_chain(folder)
    attested, problems = attestation.attested(folder, [link.record for link in links])
    if problems:
        raise InputError(problems[0])
    records = tuple(read_record(folder, link) for link in links)
    return Store(folder, tuple(links), records, attested)


def read_chain(folder: Path) -> list[Link]:
    """Read the chain; empty where there is no leaderboard yet.

    Raises:
        InputError: if it was changed.
    """
    path = folder / CHAIN
    return parse_chain(path.read_bytes(), str(path)) if path.exists() else []


def read_record(folder: Path, link: Link, *, strict: bool = False) -> AnyRecord:
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
        raise InputError(f"{path} is missing, but {CHAIN} names it")
    if path.stat().st_size > schema.MAX_BYTES:
        raise InputError(f"{path} has been changed: no record has {path.stat().st_size} bytes")
    content = path.read_bytes()
    sha256 = canonical.digest(content)
    if sha256 != link.record:
        raise InputError(
            f"{path} has been changed: its SHA-256 is {sha256}{_what_changed(content)}"
        )
    # Its canonical form was checked when it was added, and no byte has changed since.
    entry = record.from_bytes(content, str(path), strict=strict)
    commands = entry.header.actions.sha256 if isinstance(entry, Record) else None
    if commands != link.actions:
        raise InputError(f"{path} names other commands than {CHAIN} line {link.index + 1}")
    return entry


def _what_changed(content: bytes) -> str:
    """What is wrong inside a changed record, where that can be seen."""
    for strict in (False, True):
        try:
            record.from_bytes(content, "the file", strict=strict)
        except InputError as error:
            return f"; {error}"
    return ""


def newest_of(store: Store, record: Record) -> Record | None:
    """The newest record of the same entry, track and version; None if there is none."""
    of_entry = [entry for entry in store.scores if entry.key == record.key]
    return of_entry[-1] if of_entry else None


def find_record(store: Store, sha256: str) -> Record:
    """Find the record of a score by its hash, or by the unique beginning of one.

    Raises:
        InputError: if none or several begin so.
    """
    matches = [entry for entry in store.scores if entry.sha256.startswith(sha256)]
    if len(matches) != 1:
        raise InputError(f"{store.folder} holds no single record that begins with {sha256!r}")
    return matches[0]


def add(
    folder: Path, path: Path, simulators: ReplayPlants | None = None
) -> Record | HardwareRecord:
    """Add a record to a leaderboard.

    Args:
        folder: of the leaderboard; made if missing.
        path: of the record; its action file lies beside it, that of a hardware record excepted.
        simulators: to replay it on first; not replayed if not given.

    Returns:
        The record.

    Raises:
        InputError: if it is not a record, does not replay, or does not fit those that are there.
        OSError: if a file cannot be read or written.
    """
    store, added = load(folder), record.load(path)
    if isinstance(added, Withdrawal):
        raise InputError(f"{path} is a withdrawal; use ventbench board withdraw")
    if added.version != protocol.VERSION:
        raise InputError(
            f"{path} is of protocol version {added.version}; this ventbench scores and replays "
            f"version {protocol.VERSION}"
        )
    problems = conflicts([*store.records, added], start=len(store.records))
    if problems:
        raise InputError(f"{path}: {'; '.join(problems)}")
    if isinstance(added, HardwareRecord):  # no commands to replay: its pressures are measured
        _append(store, added, path.read_bytes())
        return added
    requested = actions.load(added, path.parent)
    if simulators is not None:
        from ventbench.board.replay import differences, replay

        if added.header.simulators != canonical.through_json(simulators.about()):
            raise InputError(f"{path} was scored on other simulators than those of this ventbench")
        (replayed,) = replay(simulators, added.pips, [requested])
        problems = differences(added, replayed)
        if problems:
            raise InputError(f"{path} does not replay: {'; '.join(problems)}")
    content = actions.path_of(added, path.parent).read_bytes()
    kept = actions.path_of(added, folder / RECORDS)
    files.write_atomically(kept, lambda file: file.write(content))
    _append(store, added, path.read_bytes())
    return added


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
    kept = [entry for entry in store.records if not isinstance(entry, Withdrawal)]
    matches = [entry.sha256 for entry in kept if entry.sha256.startswith(sha256)]
    if len(matches) != 1:
        raise InputError(f"{store.folder} holds no single record that begins with {sha256!r}")
    withdrawn = matches[0]
    if any(isinstance(x, Withdrawal) and x.withdraws == withdrawn for x in store.records):
        raise InputError(f"record {withdrawn[:12]} is withdrawn already")
    content = record.withdrawal(withdrawn, reason)
    withdrawal = record.from_bytes(content, "the withdrawal")
    assert isinstance(withdrawal, Withdrawal)
    _append(store, withdrawal, content)
    return withdrawal


def _append(store: Store, added: AnyRecord, content: bytes) -> None:
    """Write the record, then the chain: a crash between leaves a file that nothing names."""
    path = store.folder / RECORDS / f"{added.sha256}{record.SUFFIX}"
    files.write_atomically(path, lambda file: file.write(content))
    path = store.folder / CHAIN
    before = path.read_bytes() if path.exists() else b""
    lines = before + chain_line(len(store.links), added, store.head)
    files.write_atomically(path, lambda file: file.write(lines))


def conflicts(records: Sequence[AnyRecord], start: int = 0) -> list[str]:
    """Find records that contradict those before them: what no record can say by itself.

    Args:
        records: in the order of the chain.
        start: index of the first one to check; those before are taken as they are.

    Returns:
        One sentence for each conflict, with the record's hash.
    """
    sentences: list[str] = []
    before = _Before()
    for index, entry in enumerate(records):
        if index >= start:
            sentences += _conflicts(entry, before)
        before.append(entry)
    return sentences


@dataclass
class _Before:
    """What the records before one say.

    Attributes:
        first_of_version: first record of each protocol version.
        first_of_name: first record of each entry's name, on any track.
        newest: of each entry, by version, track and name.
        known: all scores, by their hash.
        hardware: hashes of all hardware records.
        withdrawn: hashes of those that were taken back.
    """

    first_of_version: dict[int, Record] = field(default_factory=dict)
    first_of_name: dict[str, Record] = field(default_factory=dict)
    newest: dict[tuple[int, str, str], Record] = field(default_factory=dict)
    known: dict[str, Record] = field(default_factory=dict)
    hardware: set[str] = field(default_factory=set)
    withdrawn: set[str] = field(default_factory=set)

    def append(self, entry: AnyRecord) -> None:
        if isinstance(entry, Withdrawal):
            self.withdrawn.add(entry.withdraws)
            return
        if isinstance(entry, HardwareRecord):
            self.hardware.add(entry.sha256)
            return
        self.first_of_version.setdefault(entry.version, entry)
        self.first_of_name.setdefault(entry.name, entry)
        self.newest[entry.key] = entry
        self.known[entry.sha256] = entry


def _conflicts(entry: AnyRecord, before: _Before) -> list[str]:
    name = f"record {entry.sha256}"
    if isinstance(entry, Withdrawal):
        if entry.withdraws not in before.known and entry.withdraws not in before.hardware:
            return [f"{name} withdraws {entry.withdraws[:12]}, which is not there"]
        if entry.withdraws in before.withdrawn:
            return [f"{name} withdraws {entry.withdraws[:12]} once more"]
        return []
    if entry.sha256 in before.known or entry.sha256 in before.hardware:
        return [f"{name} is on the leaderboard already"]
    sentences = []
    first = before.first_of_version.get(entry.version)
    if first is not None and isinstance(entry, Record):
        # Records of one version can only be compared over the same simulators and draws.
        pairs = zip(("simulators", "draws"), entry.basis, first.basis, strict=True)
        sentences = [
            f"{name} ({entry.name}), key {key}: differs from record {first.sha256[:12]} "
            f"({first.name}) of the same protocol version"
            for key, own, common in pairs
            if own != common
        ]
    owner = before.first_of_name.get(entry.name)
    if owner is not None and set(owner.manifest.authors) != set(entry.manifest.authors):
        sentences.append(
            f"{name} ({entry.name}), key submission.manifest.authors: the name belongs to the "
            f"authors of record {owner.sha256[:12]}; choose another name"
        )
    if isinstance(entry, HardwareRecord):
        return sentences
    superseded, newest = entry.header.supersedes, before.newest.get(entry.key)
    if superseded is None:
        if newest is not None:
            sentences.append(
                f"{name} ({entry.name}), key supersedes: the entry has record "
                f"{newest.sha256[:12]}; a new one must name it, with --supersedes and a --reason"
            )
        return sentences
    old = before.known.get(superseded)
    if old is None:
        sentences.append(f"{name}, key supersedes: {superseded[:12]} is not there")
    elif old.key != entry.key:
        sentences.append(f"{name}, key supersedes: is of another entry, track or version")
    elif newest is not None and old.sha256 != newest.sha256:
        sentences.append(
            f"{name}, key supersedes: the newest record of {entry.name} is {newest.sha256[:12]}"
        )
    elif old.official and not entry.official:
        sentences.append(f"{name} is not official and supersedes an official record")
    return sentences
