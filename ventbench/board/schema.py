"""What a record must look like before anything of it is used or shown.

A record may come from anybody: every value is checked for its type and range here, so that ranking
and pages need not; text is escaped where it is shown. msgspec checks types and ranges, and
:func:`read` what ties several keys together.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.text import deceptive, plain
from ventbench.board import canonical
from ventbench.entries.folder import CONTROLLER, combined_hash
from ventbench.entries.manifest import FAMILIES, MANIFEST, NAME, TRACKS
from ventbench.entries.runs import DRAWS
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.stressors import VERSION as STRESSORS_VERSION
from ventbench.task.stressors import conditions

#: What every record says of its form: records of another one are not read.
FORMAT, PROTOCOL = 2, 3

#: Largest record, bytes.
MAX_BYTES = 2 * 2**20

#: Longest text anywhere in a record, characters.
MAX_TEXT = 4000

#: Deepest nesting of what a record says freely about its machine and the like.
MAX_DEPTH = 6

#: How times are written; always UTC.
TIME_FORMAT = "%Y-%m-%dT%H:%M:%SZ"

#: What every record says about its scorer and its machine.
REQUIRED_VERSIONS = ("ventbench", "python", "jax", "jaxlib", "numpy")
REQUIRED_MACHINE = ("system", "kernel", "architecture")

#: Most characters of a message; a hostile record chose some of them.
_MAX_MESSAGE = 300


def matching(pattern: str) -> msgspec.Meta:
    """Constraint of a text that matches a pattern as a whole."""
    # msgspec searches; a record's text must match as a whole, and "$" would let a newline pass.
    return msgspec.Meta(pattern=rf"\A(?:{pattern})\Z")


def _among(choices: Iterable[str]) -> msgspec.Meta:
    return matching("|".join(map(re.escape, choices)))


Text = Annotated[str, msgspec.Meta(max_length=MAX_TEXT)]
Reason = Annotated[str, msgspec.Meta(max_length=MAX_TEXT, pattern=r"\S")]
Sha256 = Annotated[str, matching("[0-9a-f]{64}")]
Time = Annotated[str, matching(r"[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}Z")]
LungId = Annotated[str, _among(LUNG_IDS)]
EntryName = Annotated[str, matching(NAME.pattern)]
RoundName = Annotated[str, matching(canonical.ROUND_NAME)]
Family = Annotated[str, _among(FAMILIES)]
Track = Annotated[str, _among(TRACKS)]

#: Whole numbers that JavaScript reads as they are, and those that fit into 32 bits.
Count = Annotated[int, msgspec.Meta(ge=0, lt=2**53)]
Version = Annotated[int, msgspec.Meta(ge=1, le=10**9)]
SmallInt = Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31)]

#: No pressure of a lung comes near; sums of larger numbers would overflow, cmH2O.
_MOST = 1e6

#: Errors are null where a controller failed.
Error = Annotated[float, msgspec.Meta(ge=0.0, le=_MOST)] | None
Pressure = Annotated[float, msgspec.Meta(ge=-_MOST, le=_MOST)]
FreeForm = dict[str, Any]

T = TypeVar("T")


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A JSON object or a table of TOML with exactly these keys."""


TableT = TypeVar("TableT", bound=Table)


class RecordedManifest(Table, frozen=True):
    """What the authors say about a submission; see :class:`ventbench.entries.manifest`."""

    name: EntryName
    authors: list[Text]
    licence: Text
    api_version: Count
    family: Family
    tracks: list[Track]
    description: Text
    training: FreeForm


class RecordedSubmission(Table, frozen=True):
    """What was scored: the SHA-256 of all files together and of each by its path."""

    sha256: Sha256
    files: FreeForm
    manifest: RecordedManifest


class Submitted:
    """What every record of a submission tells by its header, simulated or on hardware."""

    header: Any

    @property
    def manifest(self) -> RecordedManifest:
        """What the authors say about the submission."""
        return self.header.submission.manifest

    @property
    def name(self) -> str:
        """Name of the submission."""
        return self.manifest.name


class Draws(Table, frozen=True):
    """The draws, keys in the order of pages: ``sha256`` is the commitment of their seed."""

    count: Annotated[int, msgspec.Meta(ge=1, lt=2**53)]
    sha256: Sha256
    version: Count
    season: RoundName

    def to_json(self) -> dict[str, Any]:
        """As the record has it."""
        return msgspec.structs.asdict(self)


class RecordedFailure(Table, frozen=True):
    """A failed cell; ``draw`` is null in the nominal run, ``condition`` none without a stressor."""

    condition: Text
    lung: LungId
    pip: float
    draw: Count | None
    kind: Text
    what: Text
    detail: Text
    breath: Count | None
    step: Count | None
    message: Text


class Commands(Table, frozen=True):
    """A file of commands by its hash; whole numbers of :data:`protocol.RESOLUTION`.

    ``shape`` is ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``, nominal cells first, or
    ``(S, L, n, BREATHS, INSPIRATION_STEPS)`` under missing physics.
    """

    sha256: Sha256
    bytes: Count
    shape: Annotated[list[Count], msgspec.Meta(min_length=5, max_length=5)]


class RecordedStress(Table, frozen=True):
    """Runs under missing physics: under all conditions of a version of the stressors, n draws."""

    stressors: Version
    commands: Commands
    failures: list[RecordedFailure]


class SubmittedContent(Table, frozen=True):
    """What all records of a submission say, simulated or on hardware."""

    format: Version
    protocol: Version
    created: Time
    provenance: FreeForm
    submission: RecordedSubmission
    sandbox: FreeForm | None
    versions: FreeForm
    machine: FreeForm
    timing: FreeForm


class ScoreContent(SubmittedContent, frozen=True, tag_field="kind", tag="score"):
    """The record of a score: what went into it, and nothing that follows from that."""

    official: bool
    track: Track
    simulators: FreeForm
    draws: Draws
    commands: Commands
    failures: list[RecordedFailure]
    stress: RecordedStress | None = None


class WithdrawalContent(Table, frozen=True, tag_field="kind", tag="withdrawal"):
    """The record that takes another one back."""

    format: Version
    created: Time
    withdraws: Sha256
    reason: Reason


def read(content: bytes, label: str, kinds: Any) -> SubmittedContent | WithdrawalContent:
    """Read and check the content of a record of one of some kinds.

    Raises:
        InputError: naming the first key that is wrong; ``label`` names the file.
    """
    record = decoded(kinds, content, label)
    for key, expected in (("format", FORMAT), ("protocol", PROTOCOL)):
        recorded = getattr(record, key, expected)
        if recorded != expected:
            raise InputError(
                f"{label}, key {key}: is {recorded}; this ventbench reads records of {key} "
                f"{expected} and no other"
            )
    try:
        datetime.strptime(record.created, TIME_FORMAT)
    except ValueError:  # a time that no calendar has
        raise InputError(f"{label}, key created: {record.created} is no date and time") from None
    for key, value in canonical.parse(content, label).items():
        check_free(value, f"{label}, key {key}")
    if isinstance(record, WithdrawalContent):
        return record
    _check_submission(record.submission, f"{label}, key submission")
    for why in filter(None, map(deceptive, record.submission.manifest.authors)):
        raise InputError(f"{label}, key submission.manifest.authors: {why}")
    _check_origin(record, label)
    if isinstance(record, ScoreContent):
        _check_consistent(record, label)
    return record


def decoded(kind: type[T], content: bytes, label: str) -> T:
    """Decode JSON of a kind.

    Raises:
        InputError: naming the first key that is wrong.
    """
    try:
        return msgspec.json.decode(content, type=kind)
    except msgspec.ValidationError as error:
        message, at, path = str(error).rpartition(" - at `$")
        if not at:
            raise InputError(f"{label}: {_short(str(error))}") from None
        key = path[:-1].removeprefix(".")
        raise InputError(f"{label}, key {_short(key)}: {_short(message)}") from None
    # Not JSON, not UTF-8, or nested without end.
    except (msgspec.DecodeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{label} is not JSON of a record: {_short(str(error))}") from None


def read_canonical(kind: type[T], path: Path) -> T:
    """Decode a file of canonical JSON of a kind.

    Raises:
        InputError: naming the first key that is wrong, or if it is not canonical.
        OSError: if it cannot be read.
    """
    content = files.read_limited(path, MAX_BYTES)
    canonical.parse(content, str(path))
    return decoded(kind, content, str(path))


def read_toml(path: Path, kind: type[TableT], most: int) -> TableT:
    """Read a table of TOML that is no link and has at most so many bytes.

    Raises:
        InputError: if it is not such a file.
        FileNotFoundError: if there is none.
    """
    content = files.read_limited(path, most)
    try:
        return msgspec.convert(tomllib.loads(content.decode()), kind)
    except (ValueError, RecursionError) as error:  # not UTF-8, not TOML, or not of this form
        raise InputError(f"{path}: {error}") from None


def _short(message: str) -> str:
    message = plain(message)
    return message if len(message) <= _MAX_MESSAGE else f"{message[:_MAX_MESSAGE]}…"


def check_free(value: Any, where: str, depth: int = MAX_DEPTH) -> None:
    """Bound the texts, the whole numbers and the nesting of JSON of any form."""
    if isinstance(value, str) and len(value) > MAX_TEXT:
        raise InputError(f"{where}: holds a text of more than {MAX_TEXT} characters")
    if isinstance(value, int) and not -(2**53) < value < 2**53:
        raise InputError(f"{where}: holds a whole number beyond 2^53")
    if not isinstance(value, dict | list):
        return
    if depth == 0:
        raise InputError(f"{where}: is nested more than {MAX_DEPTH} deep")
    for part in [*value, *value.values()] if isinstance(value, dict) else value:
        check_free(part, where, depth - 1)


def has_shape(table: Any, shape: tuple[int, ...]) -> bool:
    """Whether nested lists have a shape."""
    if len(table) != shape[0]:
        return False
    return len(shape) == 1 or all(has_shape(part, shape[1:]) for part in table)


def _check_consistent(record: ScoreContent, label: str) -> None:
    if record.track not in record.submission.manifest.tracks:
        raise InputError(f"{label}, key track: the submission does not enter it")
    if record.official and not (record.sandbox and record.sandbox.get("official") is True):
        raise InputError(f"{label}, key official: its sandbox was not official")
    stress, steps = record.stress, [protocol.BREATHS, protocol.INSPIRATION_STEPS]
    if stress is not None and record.track != "robustness":
        raise InputError(f"{label}, key stress: belongs to the robustness track")
    lungs, pips = len(LUNG_IDS), len(protocol.PIPS)
    shapes = [("commands", record.commands.shape, [lungs, 1 + record.draws.count, pips, *steps])]
    if stress is not None and stress.stressors == STRESSORS_VERSION:
        expected = [len(conditions()), lungs, DRAWS, *steps]
        shapes.append(("stress.commands", stress.commands.shape, expected))
    for key, shape, expected in shapes:
        if shape != expected:
            raise InputError(f"{label}, key {key}.shape: is not {expected}")
    for key, failures in (
        ("failures", record.failures),
        ("stress.failures", stress and stress.failures),
    ):
        cells = [(x.condition, x.lung, x.pip, x.draw) for x in failures or ()]
        if len(set(cells)) < len(cells):
            raise InputError(f"{label}, key {key}: names a cell twice")


def _check_submission(submission: RecordedSubmission, where: str) -> None:
    """Check that the hashes of the files have their form and give the hash of the submission."""
    for name, sha256 in submission.files.items():
        parts = name.split("/")
        if not name.isprintable() or {"", ".", ".."} & set(parts):
            raise InputError(f"{where}.files: {_short(repr(name))} is no path within a folder")
        if not isinstance(sha256, str) or not re.fullmatch("[0-9a-f]{64}", sha256):
            raise InputError(f"{where}.files: {_short(name)} has no SHA-256")
    for name in (CONTROLLER, MANIFEST):
        if name not in submission.files:
            raise InputError(f"{where}.files: {name} is missing")
    if combined_hash(submission.files) != submission.sha256:
        raise InputError(f"{where}.sha256: is not that of its files")


def _check_origin(record: SubmittedContent, label: str) -> None:
    """Refuse a record that does not say by which versions and on what machine it was made."""
    for table, keys in (("versions", REQUIRED_VERSIONS), ("machine", REQUIRED_MACHINE)):
        for key in keys:
            value = getattr(record, table).get(key)
            if not isinstance(value, str) or not value.strip():
                raise InputError(f"{label}, key {table}.{key}: is missing or empty")
