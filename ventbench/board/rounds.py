r"""Rounds: entries are frozen first, and a public beacon then says on what draws they are scored.

A round is a folder ``rounds/NAME/`` of the leaderboard; each file is bound by the next one:

- ``round.toml``: when it closes, the delay, the beacon's chain, how many entries an account has;
- ``protocol.json``: every number that the score depends on besides entries and draws;
- ``frozen.toml``: hashes of the two, the time, and of each entry account and hash of its files;
- ``beacon.json``: the beacon's first value after freeze and delay;
- ``bounds.npz``: best attainable and best PID of the draws, once the entries were scored;
- ``result.json``: its hash, and what became of each entry;
- ``seeds.json``: files of commands that give the scores of seeds in the result;
- ``notes.toml``, if the maintainers have written it: why an entry is where it is, a sentence each.

The seed of the draws is HMAC-SHA256 of the hash of ``frozen.toml`` with the beacon's randomness as
the key. Nobody can know it before the freeze, and nobody can choose it: the number of the value is
fixed by the time of the freeze. A round whose chain is not the pinned public one is a *rehearsal*.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
import tomli_w

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.text import deceptive, plain
from ventbench.board import beacon, canonical, schema
from ventbench.board.beacon import QUICKNET, Chain, Value
from ventbench.board.canonical import ROUNDS
from ventbench.entries import reference as references
from ventbench.entries.folder import Submission, bundled, open_submission, uncovered
from ventbench.entries.reference import Reference
from ventbench.plants import frozen
from ventbench.plants.rigs import Rigs
from ventbench.task import draws as draw_tables
from ventbench.task import protocol, stressors
from ventbench.task.draws import DEVELOPMENT, Draws

#: Files of a round, in the order in which they come to be.
OPENED, PROTOCOL, FROZEN, BEACON, BOUNDS, RESULT = canonical.ROUND_FILES

#: Time between freeze and beacon, s, and entries of an account, unless a round says otherwise.
DELAY_S, LIMIT = 600, 3

_MAX_BYTES = 5_000_000

#: Characters of a name that is none which are shown.
_MAX_NAME = 80

_Time = Annotated[datetime, msgspec.Meta(tz=True)]
_Account = Annotated[str, schema.matching(r"[A-Za-z0-9](?:[A-Za-z0-9-]{0,62}[A-Za-z0-9])?")]


class Opened(schema.Table, frozen=True):
    """Content of ``round.toml``."""

    name: schema.RoundName  #: of the round.
    opened: _Time  #: when, UTC.
    closes: _Time  #: when entries are frozen at the earliest, UTC.
    #: least time from the freeze to the beacon's value, s.
    delay_s: Annotated[int, msgspec.Meta(ge=1, le=10**7)]
    limit: Annotated[int, msgspec.Meta(ge=1, le=1000)]  #: most entries of an account.
    #: entries of the project, which no account asks for, baselines among them.
    project: list[schema.EntryName]
    chain: Chain  #: of the beacon.

    @property
    def rehearsal(self) -> bool:
        """Whether a referee stands in for the public beacon: never official."""
        return self.chain != QUICKNET


class Request(schema.Table, frozen=True):
    """Who asked for an entry, as the platform says, never the entry itself, and when."""

    name: schema.EntryName
    account: _Account
    asked: datetime


class Entered(schema.Table, frozen=True):
    """A frozen entry; entries of the project have no account."""

    name: schema.EntryName
    account: str
    sha256: schema.Sha256
    tracks: list[schema.Track]


class Frozen(schema.Table, frozen=True):
    """Content of ``frozen.toml``; ``left_out`` says why an entry that was asked for is not in."""

    round: schema.Sha256
    protocol: schema.Sha256
    frozen: _Time
    entries: Annotated[list[Entered], msgspec.Meta(min_length=1)]
    left_out: dict[str, str] = msgspec.field(default_factory=dict)


class Result(schema.Table, frozen=True):
    """Content of ``result.json``: by entry and track a record, or why there is none.

    The job of each entry leaves its part, but for ``seeds``: the ranked scores of an entry with the
    files of each of its seeds, which follow from the commands that ``seeds.json`` names.
    """

    bounds: schema.Sha256
    records: dict[str, schema.Sha256]
    failed: dict[str, str] = msgspec.field(default_factory=dict)
    seeds: dict[str, list[float]] = msgspec.field(default_factory=dict)


class Notes(schema.Table, frozen=True):
    """Content of ``notes.toml``: a sentence by entry; no rank or figure follows from it."""

    entries: dict[schema.EntryName, schema.Text]


@dataclass(frozen=True)
class Round:
    """A round as far as it has come; make one with :func:`load`."""

    folder: Path  #: of the round.
    opened: Opened  #: how it was opened.
    frozen: Frozen | None = None  #: its entries; None before.
    value: Value | None = None  #: of the beacon, checked; None before.
    result: Result | None = None  #: None before it is scored.
    frozen_sha256: str = ""  #: of ``frozen.toml``; empty before.
    #: files of commands of seeds, by entry and track.
    seeds: Mapping[str, Sequence[schema.Commands]] = field(default_factory=dict)
    #: why an entry is where it is, by name; empty if nobody has said.
    notes: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the round."""
        return self.opened.name

    @property
    def state(self) -> str:
        """``"open"``, ``"frozen"``, ``"drawn"`` or ``"scored"``."""
        steps = (self.frozen, self.value, self.result)
        return ("open", "frozen", "drawn", "scored")[sum(step is not None for step in steps)]

    @property
    def entries(self) -> Sequence[Entered]:
        """Entries that were frozen."""
        return self.frozen.entries if self.frozen else ()

    @property
    def runs(self) -> dict[str, tuple[str, str, str]]:
        """Name, track and hash of the code, by the key of what is scored in a result."""
        return {
            key_of(x.name, track): (x.name, track, x.sha256)
            for x in self.entries
            for track in x.tracks
        }

    @property
    def seed(self) -> bytes:
        """Seed of the draws; InputError if the beacon's value is not there yet."""
        if self.value is None:
            raise InputError(f"round {self.name} is {self.state}: it has no draws yet")
        return self.value.seed(self.frozen_sha256)

    @property
    def number(self) -> int:
        """Round of the beacon whose value it must take."""
        assert self.frozen is not None
        return self.opened.chain.first_at(self.frozen.frozen, self.opened.delay_s)

    @property
    def commitment(self) -> str:
        """Hash of the seed, as records state it."""
        return draw_tables.commitment(self.seed)

    def draws(self, rigs: Rigs) -> Draws:
        """Draws of the round."""
        return rigs.draws(draw_tables.COUNT, seed=self.seed, name=self.name)

    def bounds(self) -> Reference:
        """Best attainable and best PID of the draws.

        Raises:
            InputError: if the file is missing, or not that of the result.
        """
        path = self.folder / BOUNDS
        reference = references.load(path)
        if self.result is not None and files.sha256(path) != self.result.bounds:
            raise InputError(f"{path} has been changed: it is not the file that {RESULT} names")
        return reference


def key_of(entry: str, track: str) -> str:
    """What an entry on a track is called in a result."""
    return f"{entry} ({track})"


def load(leaderboard: Path, name: str) -> Round:
    """Read a round; what one file says of another must be so.

    Raises:
        InputError: naming the file that was changed.
        OSError: if one cannot be read.
    """
    folder = leaderboard / ROUNDS / name
    there = [file for file in canonical.ROUND_FILES if (folder / file).exists()]
    if missing := set(canonical.ROUND_FILES[: len(there)]) - set(there):
        raise InputError(f"{folder / min(missing)} is missing: {there[-1]} is there")
    opened = _toml(folder / OPENED, Opened)
    if opened.name != name or name == DEVELOPMENT:
        raise InputError(f"{folder / OPENED}, key name: {opened.name} is not the folder's name")
    notes_path = folder / canonical.NOTES
    notes = _toml(notes_path, Notes).entries if notes_path.exists() else {}
    round_ = Round(folder, opened, notes=notes)
    if FROZEN in there:
        frozen = _toml(folder / FROZEN, Frozen)
        for key, file in (("round", OPENED), ("protocol", PROTOCOL)):
            if getattr(frozen, key) != files.sha256(folder / file):
                raise InputError(f"{folder / file} has been changed since the round was frozen")
        if frozen.frozen < opened.closes:
            raise InputError(f"{folder / FROZEN}, key frozen: is before the round closed")
        if len({entry.name for entry in frozen.entries}) < len(frozen.entries):
            raise InputError(f"{folder / FROZEN}, key entries: names one twice")
        round_ = replace(round_, frozen=frozen, frozen_sha256=files.sha256(folder / FROZEN))
    if BEACON in there:
        value = schema.read_canonical(Value, folder / BEACON)
        beacon.check(value, opened.chain, round_.number, str(folder / BEACON))
        round_ = replace(round_, value=value, seeds=seed_commands(folder))
    if RESULT in there:
        round_ = replace(round_, result=schema.read_canonical(Result, folder / RESULT))
    return round_


def seed_commands(folder: Path) -> dict[str, list[schema.Commands]]:
    """Files of commands of seeds, of a round or of the job of an entry; none without the file."""
    path = folder / canonical.SEEDS
    kind = dict[str, list[schema.Commands]]
    return schema.read_canonical(kind, path) if path.exists() else {}


def names(leaderboard: Path) -> list[str]:
    """Names of the rounds of a leaderboard."""
    return sorted(path.name for path in (leaderboard / ROUNDS).glob("*") if path.is_dir())


def load_all(leaderboard: Path) -> tuple[Round, ...]:
    """All rounds, the newest first; arguments and errors as of :func:`load`."""
    return newest_first(load(leaderboard, name) for name in names(leaderboard))


def newest_first(some: Iterable[Round]) -> tuple[Round, ...]:
    """Rounds in the order of pages: that which closed last comes first."""
    return tuple(sorted(some, key=lambda x: (x.opened.closes, x.name), reverse=True))


def project_entries(leaderboard: Path) -> list[str]:
    """Entries of the project: those of the newest round, or the bundled ones before the first.

    What outsiders have sent since then lies among the bundled submissions too, and is theirs.
    """
    all_rounds = load_all(leaderboard)
    return list(all_rounds[0].opened.project) if all_rounds else bundled()


def open_round(
    leaderboard: Path,
    name: str,
    closes: datetime,
    project: Sequence[str],
    *,
    delay_s: int = DELAY_S,
    limit: int = LIMIT,
    chain: Chain = QUICKNET,
    now: datetime | None = None,
) -> Round:
    """Open a round; arguments as of :class:`Opened`.

    Raises:
        InputError: if there is such a round, or a value is out of range.
    """
    values = {
        "name": name,
        "opened": _seconds(now),
        "closes": _seconds(closes),
        "delay_s": delay_s,
        "limit": limit,
        "project": sorted(project),
        "chain": msgspec.structs.asdict(chain),
    }
    try:
        msgspec.convert(values, Opened)
    except msgspec.ValidationError as error:
        raise InputError(f"round {name!r}: {error}") from None
    folder = leaderboard / ROUNDS / name
    if name == DEVELOPMENT or folder.exists():
        raise InputError(f"{folder} is there already, or its name is taken")
    files.write_bytes(folder / OPENED, tomli_w.dumps(values).encode())
    return load(leaderboard, name)


def freeze(
    leaderboard: Path,
    name: str,
    submissions: Path,
    requests: Sequence[Request | Mapping[str, Any]],
    simulators: Mapping[str, Any],
    *,
    now: datetime | None = None,
) -> Round:
    """Take the hashes of all entries, one folder each; later changes do not count.

    Requests say who asked for each, as the platform gives them; entries of the project need none. A
    request that is none, and an entry that cannot be opened, leave themselves out, with the reason.

    Raises:
        InputError: if the round is not open or has not closed yet, or nothing can be frozen.
    """
    round_, at = load(leaderboard, name), _seconds(now)
    if round_.state != "open":
        raise InputError(f"round {name} is {round_.state} already")
    if at < round_.opened.closes:
        raise InputError(f"round {name} closes at {round_.opened.closes:%Y-%m-%d %H:%M:%S} UTC")
    # Of the earliest one last.
    owners = {x.name: x.account for before in load_all(leaderboard) for x in before.entries}
    good, bad = _sorted_out(requests)
    requested: dict[str, Request] = {}
    for request in sorted(good, key=lambda x: (x.asked, x.name)):
        requested.setdefault(request.name, request)
    order = [*round_.opened.project, *(x for x in requested if x not in round_.opened.project)]
    entries: list[dict[str, Any]] = []
    excluded: dict[str, str] = {}
    count: dict[str, int] = {}
    for entry in order:
        account = "" if entry in round_.opened.project else requested[entry].account.lower()
        try:
            submission = _named(submissions / entry, entry)
            if owners.get(entry, account) != account:
                raise InputError("the name belongs to another account since an earlier round")
            if account and count.get(account, 0) >= round_.opened.limit:
                raise InputError(f"account {account} has {round_.opened.limit} entries already")
        except (InputError, OSError) as error:
            excluded[entry] = str(error)[: schema.MAX_TEXT]
            continue
        count[account] = count.get(account, 0) + 1
        tracks = list(submission.manifest.tracks)
        entries.append(
            {"name": entry, "account": account, "sha256": submission.sha256, "tracks": tracks}
        )
    excluded |= {x: why for x, why in bad.items() if x not in order}
    if not entries:
        raise InputError(f"round {name}: no entry can be frozen; {excluded}")
    written = canonical.canonical(protocol_of(simulators))
    files.write_bytes(round_.folder / PROTOCOL, written)
    frozen = {
        "round": files.sha256(round_.folder / OPENED),
        "protocol": canonical.digest(written),
        "frozen": at,
        "entries": entries,
        "left_out": excluded,
    }
    files.write_bytes(round_.folder / FROZEN, tomli_w.dumps(frozen).encode())
    return load(leaderboard, name)


def _sorted_out(
    requests: Sequence[Request | Mapping[str, Any]],
) -> tuple[list[Request], dict[str, str]]:
    """Requests, and by what they call themselves why others are none."""
    good, bad = [], {}
    for request in requests:
        try:
            good.append(msgspec.convert(request, Request, from_attributes=True))
        except msgspec.ValidationError as error:
            stated_name = request.get("name") if isinstance(request, Mapping) else None
            name = plain(str(stated_name or "without a name"))[:_MAX_NAME]
            bad[name] = f"is no request: {error}"[: schema.MAX_TEXT]
    return good, bad


def _named(folder: Path, name: str) -> Submission:
    """Open a submission that must have the name of its folder, and authors who can be read."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder.name}")
    if strange := uncovered(folder):
        raise InputError(f"{strange[0]} is in no hash: a cache, a link or compiled code; remove it")
    submission = open_submission(str(folder))
    if submission.manifest.name != name:
        raise InputError(f"submission.toml calls it {submission.manifest.name}")
    for author in submission.manifest.authors:
        if why := deceptive(author):
            raise InputError(f"submission.toml, key authors: {why}")
    return submission


def draw(leaderboard: Path, name: str, content: bytes, *, now: datetime | None = None) -> Round:
    """Take the beacon's value, as relays publish it.

    Raises:
        InputError: if the round is not frozen, the time has not come, or the value is not the one
            that it must take.
    """
    round_ = load(leaderboard, name)
    if round_.state != "frozen":
        raise InputError(f"round {name} is {round_.state}; it must be frozen")
    value = beacon.take(content, round_.opened.chain, round_.number, now)
    files.write_bytes(round_.folder / BEACON, canonical.canonical(msgspec.structs.asdict(value)))
    return load(leaderboard, name)


def protocol_of(simulators: Mapping[str, Any]) -> dict[str, Any]:
    """Every number that a score depends on besides entry and draws, as JSON values."""
    values = {
        "simulators": dict(simulators),
        "protocol": _constants(protocol),
        "draws": _constants(draw_tables),
        "pid": references.PID_GAINS,
        "population": frozen.ROLES_SHA256,
        "stress": [condition.id for condition in stressors.conditions()],
        "stressors": stressors.VERSION,
        "version": schema.PROTOCOL,
    }
    return canonical.through_json(values)


def _constants(module: Any) -> dict[str, Any]:
    """Public constants of a module that JSON can hold."""
    constants = {}
    for key, value in vars(module).items():
        plain = isinstance(value, int | float | str | tuple | list | dict)
        if key.isupper() and not key.startswith("_") and plain:
            constants[key] = value
    return constants


def protocol_differences(round_: Round, simulators: Mapping[str, Any]) -> list[str]:
    """Parts of the protocol of a round that this ventbench does not have."""
    path = round_.folder / PROTOCOL
    recorded, current = canonical.parse(path.read_bytes(), str(path)), protocol_of(simulators)
    return [key for key in sorted({*recorded, *current}) if recorded.get(key) != current.get(key)]


def read_requests(path: Path) -> list[Any]:
    """Read who asked for which entry: a JSON list of objects with the keys of :class:`Request`.

    What is in the list is for :func:`freeze` to judge, one by one.

    Raises:
        InputError: if it is no such file.
    """
    return schema.decoded(list[Any], path.read_bytes(), str(path))


def _seconds(when: datetime | None) -> datetime:
    return (when or datetime.now(UTC)).astimezone(UTC).replace(microsecond=0)


def _toml(path: Path, kind: type[schema.TableT]) -> schema.TableT:
    try:
        return schema.read_toml(path, kind, _MAX_BYTES)
    except FileNotFoundError:
        raise InputError(f"{path} is not there: there is no such round") from None
