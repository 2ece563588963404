"""The folder of a leaderboard: records, their commands, and the chain over them.

``chain.jsonl`` has one line a record in the order of arrival, each with the hash of the line
before. It makes the order and the set of records as immutable as a record itself: nothing can be
changed, swapped or left out in the middle without changing every later line, and the last line's
hash (the *head*) stands for all of them. Only the end can be cut off unseen; whoever has noted a
head can check that it is still there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ventbench import files, protocol, seasons
from ventbench.board import actions, attestation, canonical, record, schema
from ventbench.board.conflicts import conflicts
from ventbench.board.hardware import HardwareRecord
from ventbench.board.layout import CHAIN, RECORDS, SEASONS
from ventbench.board.record import AnyRecord, Record, Sealed, Withdrawal, commands_of
from ventbench.errors import InputError
from ventbench.seasons import Season

if TYPE_CHECKING:
    from ventbench.board.replay import Replayable

#: Stands for the hash of the line before the first.
CHAIN_START = "0" * 64


@dataclass(frozen=True)
class Link:
    """One line of the chain.

    Attributes:
        index: of the line, from 0.
        record: SHA-256 of the record.
        actions: SHA-256 of its action file, or of its ciphertext; None for a withdrawal.
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
            :mod:`ventbench.board.attestation`. A record that was sealed is attested where the
            sealed one is.
        seasons: by id.
        breaches: why records of seasons are not official, by their hashes; see
            :func:`ventbench.board.sealed.breaches`.
    """

    folder: Path
    links: tuple[Link, ...]
    records: tuple[AnyRecord, ...]
    attested: frozenset[str]
    seasons: Mapping[str, Season] = field(default_factory=dict)
    breaches: Mapping[str, str] = field(default_factory=dict)

    @property
    def head(self) -> str:
        """SHA-256 that stands for all records and their order."""
        return chain_head(self.links)

    @property
    def scores(self) -> list[Record]:
        """Records of scores only."""
        return [entry for entry in self.records if isinstance(entry, Record)]

    @property
    def sealed(self) -> list[Sealed]:
        """Sealed records only."""
        return [entry for entry in self.records if isinstance(entry, Sealed)]


def chain_line(index: int, added: AnyRecord, previous: str) -> bytes:
    """Return the chain's line of a record.

    Args:
        index: of the line, from 0.
        added: the record.
        previous: SHA-256 of the line before; :data:`CHAIN_START` for the first.
    """
    line = {
        "index": index,
        "record": added.sha256,
        "actions": commands_of(added),
        "previous": previous,
    }
    return canonical.canonical(line)


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
    return assembled(folder, links, records, attested, read_seasons(folder))


def assembled(
    folder: Path,
    links: Sequence[Link],
    records: Sequence[AnyRecord],
    attested: frozenset[str],
    known: Mapping[str, Season],
) -> Store:
    """Put together what was read, and judge the records of seasons by the rules of these.

    Args:
        folder: of the leaderboard.
        links: lines of the chain.
        records: one for each line.
        attested: hashes of the records that are signed or accepted.
        known: seasons by id.
    """
    from ventbench.board.sealed import breaches

    vouched = {
        entry.content.record
        for entry in records
        if isinstance(entry, Sealed) and entry.sha256 in attested
    }
    against = breaches(records, known, attested)
    there = {entry.sha256 for entry in records}
    for entry in records:
        if isinstance(entry, Sealed) and entry.content.record not in there:
            season = known.get(entry.content.season.id)
            if season is not None and season.seed is not None:
                against[entry.sha256] = "not official: it does not hold the record that it names"
    counting = frozenset((attested | vouched) - against.keys())
    return Store(folder, tuple(links), tuple(records), counting, known, against)


def season_path(folder: Path, name: str) -> Path:
    """Where the file of a season lies."""
    return folder / SEASONS / f"{name}.toml"


def read_seasons(folder: Path) -> dict[str, Season]:
    """Read the seasons of a leaderboard, by id.

    Raises:
        InputError: naming the first season file that is wrong.
    """
    paths = sorted((folder / SEASONS).glob("*.toml"))
    return {path.stem: seasons.read_season(path) for path in paths}


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
    if commands_of(entry) != link.actions:
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


def newest_of(store: Store, record: Record | Sealed) -> Record | Sealed | None:
    """The newest record of the same entry, track and version or season; None if there is none."""
    of_entry = [entry for entry in (*store.scores, *store.sealed) if entry.key == record.key]
    return of_entry[-1] if of_entry else None


def find_record(store: Store, sha256: str) -> Record | Sealed:
    """Find the record of a score, sealed or not, by its hash or the unique beginning of one.

    Raises:
        InputError: if none or several begin so.
    """
    entries = (*store.scores, *store.sealed)
    matches = [entry for entry in entries if entry.sha256.startswith(sha256)]
    if len(matches) != 1:
        raise InputError(f"{store.folder} holds no single record that begins with {sha256!r}")
    return matches[0]


def add_sealed(
    folder: Path,
    path: Path,
    *,
    seed: bytes | None = None,
    simulators: Replayable | None = None,
) -> Sealed:
    """Add a sealed record to a leaderboard.

    Args:
        folder: of the leaderboard.
        path: of the record; its ciphertext lies beside it.
        seed: of the season, to look inside first; else nobody can until it is revealed.
        simulators: to replay what is inside.

    Returns:
        The record.

    Raises:
        InputError: if it is not a sealed record of a season that is open, holds something else than
            it says, or does not fit the records that are there.
        OSError: if a file cannot be read or written.
    """
    from ventbench.board import sealed

    store, added = load(folder), record.load(path)
    if not isinstance(added, Sealed):
        raise InputError(f"{path} is not a sealed record")
    ciphertext = sealed.load(added, path.parent)
    season = store.seasons.get(added.content.season.id)
    if season is None:
        raise InputError(f"{path}: {season_path(folder, added.content.season.id)} is missing")
    problems = sealed.belongs(added, season)
    if season.seed is not None:
        problems.append(f"season {season.id} is over: its seed is public")
    problems += conflicts([*store.records, added], start=len(store.records))
    if problems:
        raise InputError(f"{path}: {'; '.join(problems)}")
    if seed is not None:
        inside = sealed.unseal(added, ciphertext, season, seed)
        if simulators is not None:
            require_replay(inside.record, inside.commands, simulators, str(path), seed)
    kept = sealed.path_of(added, folder / RECORDS)
    files.write_atomically(kept, lambda file: file.write(ciphertext))
    _append(store, added, path.read_bytes())
    return added


@dataclass(frozen=True)
class Revealed:
    """What came of the sealed records of a season.

    Attributes:
        opened: records that joined the leaderboard.
        void: why a sealed record stays as it is, by its hash: it does not hold what it says.
    """

    opened: tuple[Record, ...]
    void: Mapping[str, str]


def reveal(folder: Path, name: str, seed: bytes, simulators: Replayable | None = None) -> Revealed:
    """Reveal the seed of a season and open its sealed records.

    What was opened before is left alone, so that an interrupted call can be repeated. A record that
    does not hold what it says is void: else anybody's forgery could stop the reveal.

    Args:
        folder: of the leaderboard.
        name: of the season.
        seed: of the season.
        simulators: to replay each record on; not replayed if not given.

    Raises:
        InputError: if there is no such season, or the seed is not the one that was committed to;
            nothing has then been written.
        OSError: if a file cannot be read or written.
    """
    from ventbench.board import sealed

    store = load(folder)
    if name not in store.seasons:
        raise InputError(f"{season_path(folder, name)} is missing")
    season = seasons.reveal(store.seasons[name], seed)
    there = {entry.sha256 for entry in store.records}
    waiting, void = [], {}
    reference = None
    if season.protocol > 1 and store.sealed and simulators is not None:
        reference = sealed.open_reference(folder, season, seed)
    for entry in store.sealed:
        if entry.content.season.id != name or entry.content.record in there:
            continue
        try:
            inside = sealed.unseal(entry, sealed.load(entry, folder / RECORDS), season, seed)
            if simulators is not None:
                label = f"the record of {inside.record.name}"
                require_replay(inside.record, inside.commands, simulators, label, seed)
            if reference is not None and (
                wrong := sealed.other_reference(inside.record, reference)
            ):
                raise InputError(f"record {inside.record.sha256}, {'; '.join(wrong)}")
            waiting.append(inside)
        except InputError as error:
            void[entry.sha256] = str(error)
    seasons.write_season(season_path(folder, name), season)
    for inside in waiting:
        kept = actions.path_of(inside.record, folder / RECORDS)
        commands = inside.commands
        files.write_atomically(kept, lambda file, commands=commands: file.write(commands))
        _append(load(folder), inside.record, inside.content)
    return Revealed(tuple(inside.record for inside in waiting), void)


def require_replay(
    score: Record,
    commands: bytes,
    simulators: Replayable,
    label: str,
    seed: bytes | None = None,
) -> None:
    """Replay a record.

    Args:
        score: the record.
        commands: content of its action file.
        simulators: that it names, or a function that loads those of a protocol's version.
        label: names it in messages.
        seed: of its season, for hidden draws.

    Raises:
        InputError: if it was scored on other simulators, or does not replay.
    """
    from ventbench.board.replay import differences, draws_of, replay

    if callable(simulators):
        simulators = simulators(score.version)
    if score.header.simulators != canonical.through_json(simulators.about()):
        raise InputError(f"{label} was scored on other simulators than those of this ventbench")
    requested = actions.decode(commands, score.header.actions.shape, label)
    drawn = draws_of(score.header, simulators, seed)
    (replayed,) = replay(simulators, score.pips, [requested], drawn)
    problems = differences(score, replayed)
    if problems:
        raise InputError(f"{label} does not replay: {'; '.join(problems)}")


def add(folder: Path, path: Path, simulators: Replayable | None = None) -> Record | HardwareRecord:
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
    if isinstance(added, Sealed):
        raise InputError(f"{path} is a sealed record; use add_sealed")
    if isinstance(added, Withdrawal):
        raise InputError(f"{path} is a withdrawal; use ventbench board withdraw")
    if added.version not in protocol.VERSIONS:
        raise InputError(
            f"{path} is of protocol version {added.version}; this ventbench scores and replays "
            f"versions {', '.join(map(str, protocol.VERSIONS))}"
        )
    problems = conflicts([*store.records, added], start=len(store.records))
    if problems:
        raise InputError(f"{path}: {'; '.join(problems)}")
    if isinstance(added, HardwareRecord):  # no commands to replay: its pressures are measured
        _append(store, added, path.read_bytes())
        return added
    actions.load(added, path.parent)
    content = actions.path_of(added, path.parent).read_bytes()
    if simulators is not None:
        require_replay(added, content, simulators, str(path))
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
