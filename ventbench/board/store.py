"""The folder of a leaderboard: records and their commands, in the order in which they follow.

Every file in ``records/`` is named by its SHA-256, so that none can be changed unseen. A record
that takes the place of another one, or takes it back, names it; what they do not order, the times
of the records do. That none is missing shows in the history of the repository, and the job that
publishes refuses to drop one; see ``ci/publish.py``.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.board import attestation, canonical, record, rounds, schema
from ventbench.board.canonical import RECORDS
from ventbench.board.record import AnyRecord, HardwareRecord, Record, Withdrawal
from ventbench.board.rounds import Round
from ventbench.board.schema import Commands
from ventbench.task import environment, protocol

#: Largest file of commands, bytes: those of the stress track, were they noise.
MAX_COMMANDS_BYTES = 2_000_000


@dataclass(frozen=True)
class Store:
    """All records of a leaderboard, each after those that it names."""

    folder: Path  #: of the leaderboard.
    records: tuple[AnyRecord, ...]  #: all of them.
    #: hashes of the records that somebody who may do so vouches for; see
    #: :mod:`ventbench.board.attestation`.
    attested: frozenset[str]
    rounds: tuple[Round, ...] = ()  #: all of them, the newest first.

    @cached_property
    def withdrawn(self) -> dict[str, str]:
        """Why records were taken back, by hash."""
        return {
            x.header.withdraws: x.header.reason
            for x in self.records
            if isinstance(x, Withdrawal) and x.sha256 in self.attested
        }

    @cached_property
    def seeded(self) -> dict[str, Round]:
        """Rounds that have draws, by name."""
        return {x.name: x for x in self.rounds if x.value is not None}

    def round_of(self, score: Record) -> Round | None:
        """Round on whose draws a record was scored; None for practice."""
        return self.seeded.get(score.draws)

    @property
    def scores(self) -> list[Record]:
        """Records of scores only."""
        return [entry for entry in self.records if isinstance(entry, Record)]


def record_paths(folder: Path) -> list[Path]:
    """Paths of the records of a leaderboard; InputError if there is no such folder."""
    if not folder.is_dir():
        raise InputError(
            f"{folder}: there is no such folder; the published leaderboard is what `ventbench "
            "board show` shows without --folder. Give the folder of a checkout, or begin one of "
            "your own with `ventbench board add RECORD`"
        )
    paths = sorted((folder / RECORDS).glob(f"*{record.SUFFIX}"))
    return [path for path in paths if canonical.named(f"{RECORDS}/{path.name}")]


def path_of(folder: Path, sha256: str) -> Path:
    """Where a record of a leaderboard lies."""
    return folder / RECORDS / f"{sha256}{record.SUFFIX}"


def load(folder: Path) -> Store:
    """Read a leaderboard; every record is checked against its hash and its signature.

    Raises:
        InputError: naming the file that was changed, or holds a wrong signature.
        OSError: if one cannot be read.
    """
    records = in_order(read_record(path) for path in record_paths(folder))
    attested, problems = attestation.attested(folder, measured(records))
    if problems:
        raise InputError(problems[0])
    return Store(folder, records, attested, rounds.load_all(folder))


def measured(records: Iterable[AnyRecord]) -> dict[str, str | None]:
    """By the hash of each record that of its raw recording; None for what was not measured."""
    return {
        x.sha256: x.header.recording.sha256 if isinstance(x, HardwareRecord) else None
        for x in records
    }


def in_order(records: Iterable[AnyRecord]) -> tuple[AnyRecord, ...]:
    """Sort records by their times, withdrawals after what they withdraw."""
    by_hash = {entry.sha256: entry for entry in records}

    def place(entry: AnyRecord) -> tuple[str, bool, str]:
        takes_back = isinstance(entry, Withdrawal)
        earlier = by_hash.get(entry.header.withdraws, entry) if takes_back else entry
        created = max(entry.header.created, earlier.header.created)
        return created, takes_back, entry.sha256

    return tuple(sorted(by_hash.values(), key=place))


def read_record(path: Path) -> AnyRecord:
    """Read a record, named by its SHA-256.

    Raises:
        InputError: if it was changed.
        OSError: if it cannot be read.
    """
    content = files.read_limited(path, schema.MAX_BYTES)
    sha256, why = canonical.digest(content), ""
    if sha256 == path.stem:
        return record.from_bytes(content, str(path))
    try:  # where it can be seen, say what is wrong inside
        record.from_bytes(content, "the file")
    except InputError as error:
        why = f"; {error}"
    raise InputError(f"{path} has been changed: its SHA-256 is {sha256}{why}")


def find_record(
    store: Store, sha256: str, kind: type[Record | HardwareRecord] | None = None
) -> Record | HardwareRecord:
    """Find a record, a score or of hardware, by its hash or the unique beginning of one.

    Raises:
        InputError: if none or several of the kind begin so.
    """
    candidates = [x for x in store.records if isinstance(x, kind or Record | HardwareRecord)]
    matches = [entry for entry in candidates if entry.sha256.startswith(sha256)]
    if len(matches) != 1 or isinstance(matches[0], Withdrawal):
        raise InputError(f"{store.folder} holds no single record that begins with {sha256!r}")
    return matches[0]


def find_signed(folder: Path, named: str) -> Path:
    """Find a file that a key signs: by its path, or the beginning of a record's hash.

    Raises:
        InputError: if it is no such file, or several of them.
    """
    if (path := Path(named)) in attestation.statements(folder):
        return path
    matches = sorted((folder / RECORDS).glob(f"{named}*{record.SUFFIX}"))
    if len(matches) != 1:
        raise InputError(f"{folder} holds no single record that begins with {named!r}")
    return matches[0]


def add(
    folder: Path,
    path: Path,
    require: Callable[[Record, Path, Store], object] | None = None,
    *,
    seeds: Sequence[Commands] = (),
) -> Record | HardwareRecord:
    """Add a record, beside which its commands lie, to a leaderboard, which is made if missing.

    Args:
        folder: of the leaderboard.
        path: of the record.
        require: called with a record of scores, the folder of its commands and the leaderboard
            before anything is written, such as :func:`ventbench.board.replay.require_replay` on
            the simulators; raises to refuse.
        seeds: more commands beside it, of seeds of its entry.

    Raises:
        InputError: if it is not a record, does not replay, or does not fit those that are there.
        OSError: if a file cannot be read or written.
    """
    store = load(folder) if folder.is_dir() else Store(folder, (), frozenset())
    added = record.load(path)
    if isinstance(added, Withdrawal):
        raise InputError(f"{path} is a withdrawal; use ventbench board withdraw")
    counting = [
        x for x in store.records if not isinstance(x, Withdrawal) or x.sha256 in store.attested
    ]
    problems = conflicts([*counting, added], start=len(counting))
    if problems:
        raise InputError(f"{path}: {'; '.join(problems)}")
    if isinstance(added, Record):  # a hardware record has measured pressures, and no commands
        for commands in added.commands:
            load_commands(commands, path.parent)
        if require is not None:
            require(added, path.parent, store)
        for commands in (*added.commands, *seeds):
            content = commands_path(commands, path.parent).read_bytes()
            files.write_bytes(commands_path(commands, folder / RECORDS), content)
    files.write_bytes(path_of(folder, added.sha256), path.read_bytes())
    return added


def withdraw(folder: Path, sha256: str, reason: str) -> Withdrawal:
    """Take a record back, named by the beginning of its SHA-256, for a reason that the page shows.

    It stays in the history, and its entry is no longer ranked once a key has signed the withdrawal,
    or a reviewed line of the list names it.

    Raises:
        InputError: if there is no such record, no reason, or it was withdrawn before.
    """
    store = load(folder)
    withdrawn = find_record(store, sha256).sha256
    if any(isinstance(x, Withdrawal) and x.header.withdraws == withdrawn for x in store.records):
        raise InputError(f"record {withdrawn[:12]} is withdrawn already")
    content = record.withdrawal(withdrawn, reason)
    withdrawal = record.from_bytes(content, "the withdrawal")
    assert isinstance(withdrawal, Withdrawal)
    files.write_bytes(path_of(folder, withdrawal.sha256), content)
    return withdrawal


def conflicts(records: Sequence[AnyRecord], start: int = 0) -> list[str]:
    """Find records that contradict those before them: what no record can say by itself.

    Records are in the order of :func:`in_order`; those before ``start`` are taken as they are. One
    sentence for each conflict, with the record's hash.
    """
    sentences: list[str] = []
    by_hash: dict[str, AnyRecord] = {}
    first: dict[str, Record] = {}  # on each draws, by their name
    counting: dict[tuple[str, str, str], Record] = {}  # of each entry, by draws, track and name
    # Whenever it was withdrawn: a record that was made before may be added after.
    withdrawn = {x.header.withdraws for x in records if isinstance(x, Withdrawal)}
    withdrawn_before: set[str] = set()
    for index, entry in enumerate(records):
        name, problems = f"record {entry.sha256}", list[str]()
        if isinstance(entry, Withdrawal):
            sha256 = entry.header.withdraws
            if not isinstance(by_hash.get(sha256), Record | HardwareRecord):
                problems = [f"{name} withdraws {sha256[:12]}, which is not there"]
            elif sha256 in withdrawn_before:
                problems = [f"{name} withdraws {sha256[:12]} once more"]
            withdrawn_before.add(sha256)
        elif entry.sha256 in by_hash:
            problems = [f"{name} is on the leaderboard already"]
        elif isinstance(entry, Record):
            incumbent = entry
            if entry.sha256 not in withdrawn:
                incumbent = counting.setdefault(entry.key, entry)
            problems = _conflicts(entry, first.setdefault(entry.key[0], entry), incumbent)
        by_hash[entry.sha256] = entry
        sentences += problems if index >= start else []
    return sentences


def _conflicts(entry: Record, first: Record, incumbent: Record) -> list[str]:
    """Conflicts of a score with the first on its draws, and with the one of its entry."""
    name = f"record {entry.sha256} ({entry.name})"
    # Records can only be compared over the same simulators and draws.
    sentences = [
        f"{name}, key {key}: differs from record {first.sha256[:12]} ({first.name})"
        for key in ("simulators", "draws")
        if getattr(entry.header, key) != getattr(first.header, key)
    ]
    if incumbent is not entry:
        sentences.append(
            f"{name}: the entry has record {incumbent.sha256[:12]}; withdraw that "
            'first, ventbench board withdraw HASH --reason "why"'
        )
    return sentences


def commands_path(commands: Commands, folder: Path) -> Path:
    """Where a file of commands lies."""
    return folder / f"{commands.sha256}{canonical.ACTIONS_SUFFIX}"


def described(content: bytes, shape: Sequence[int]) -> Commands:
    """What a record says of a file of commands."""
    return Commands(canonical.digest(content), len(content), list(shape))


def save_commands(requested: Floats, folder: Path) -> Commands:
    """Write a file of commands, %, of any shape."""
    content = encode(requested)
    commands = described(content, requested.shape)
    files.write_bytes(commands_path(commands, folder), content)
    return commands


def load_commands(commands: Commands, folder: Path) -> Floats:
    """Read a file of commands from a folder.

    Returns:
        %, of the shape that is stated.

    Raises:
        InputError: if the file is missing, or not the one that is named.
    """
    path = commands_path(commands, folder)
    try:
        content = files.read_limited(path, MAX_COMMANDS_BYTES)
    except FileNotFoundError:
        raise InputError(f"{path} is missing: the commands of a record") from None
    if (sha256 := canonical.digest(content)) != commands.sha256:
        raise InputError(f"{path} has been changed: its SHA-256 is {sha256}")
    if len(content) != commands.bytes:
        raise InputError(f"key commands.bytes: {path} has {len(content)}")
    return decode(content, commands.shape, str(path))


def encode(commands: Floats) -> bytes:
    """Return the content of a file of commands, %, of any shape, to the step of the valve.

    The file is zlib over byte planes of little-endian 32-bit numbers of steps, each less that of
    the command before: all first bytes, then all second bytes, and so on.
    """
    steps = np.rint(environment.resolved(commands) / protocol.RESOLUTION).astype(np.int64)
    moves = np.diff(steps.ravel(), prepend=0).astype("<i4")
    planes = moves.view(np.uint8).reshape(-1, 4).T
    return zlib.compress(np.ascontiguousarray(planes).tobytes(), 9)


def decode(content: bytes, shape: Sequence[int], label: str) -> Floats:
    """Return the commands, %, in the shape that the record states; ``label`` names the file.

    Never takes more memory than the shape says, whatever the content is.

    Raises:
        InputError: if the content is not such a file of this shape.
    """
    size = 4 * int(np.prod(shape, dtype=np.int64))
    inflate = zlib.decompressobj()
    try:
        raw = inflate.decompress(content, size + 1)
    except zlib.error as error:
        raise InputError(f"{label} is not a file of commands: {error}") from None
    if len(raw) != size or not inflate.eof or inflate.unused_data:
        raise InputError(f"{label} does not hold commands of shape {tuple(shape)}")
    planes = np.ascontiguousarray(np.frombuffer(raw, np.uint8).reshape(4, -1).T)
    steps = np.cumsum(planes.view("<i4").ravel(), dtype=np.int64)
    most = round(protocol.U_MAX / protocol.RESOLUTION)
    if steps.size and not 0 <= steps.min() <= steps.max() <= most:
        raise InputError(f"{label} holds a command outside 0..{protocol.U_MAX:g} %")
    return environment.resolved(steps.reshape(tuple(shape)) * protocol.RESOLUTION)
