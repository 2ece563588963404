"""Records of hidden draws: sealed until the season's seed is revealed, then open to everybody.

A record holds errors of cells, pressures and commands. Draws follow from them: commands answer to
noisy readings, errors of known commands give away the lung, messages may quote observations. So a
record of hidden draws is published in two parts:

- a *sealed record*, readable: submission, track, season, whether all cells were complete and safe,
  and scores rounded to 0.01, so that a run tells about ten bits;
- the record itself with its commands as a ciphertext, whose key follows from the season's seed.

The commitment to the seed binds both: when the seed is revealed, everybody opens all records,
replays them and compares. Nobody need be trusted to keep anything until then.
"""

from __future__ import annotations

import secrets
import struct
import tempfile
import unicodedata
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ventbench import files, seasons
from ventbench.board import actions, canonical, layout, record, schema
from ventbench.board.record import AnyRecord, Record, Sealed
from ventbench.errors import InputError
from ventbench.seasons import Season

if TYPE_CHECKING:
    from ventbench.headroom.reference import Reference

#: Decimals of a published score. A controller can make its score say something about the draws that
#: it met: two decimals of a score below ten are ten bits a run.
DECIMALS = 2

#: Content is filled up to a multiple of this many bytes, so that its length says next to nothing.
_PAGE = 1 << 16

#: Largest ciphertext, bytes.
MAX_BYTES = schema.MAX_BYTES + actions.MAX_BYTES + 2 * _PAGE

#: Largest file of reference errors, bytes.
MAX_REFERENCE_BYTES = 21_000_000

_SALT = 16
_LENGTHS = struct.Struct("<II")
_RECORD, _REFERENCE = b"ventbench sealed record 1\n", b"ventbench sealed reference 1\n"

#: Keys that a sealed record has from the record inside.
_COMMON = (
    *("format", "protocol", "created", "official", "track", "submission", "sandbox"),
    *("versions", "machine", "provenance"),
)


@dataclass(frozen=True)
class SealedDraft:
    """A sealed record and its ciphertext, not yet in any folder.

    Attributes:
        content: bytes of the sealed record.
        ciphertext: bytes of the file beside it.
    """

    content: bytes
    ciphertext: bytes

    def save(self, folder: Path) -> Path:
        """Write both files, each named by its hash.

        Returns:
            Path of the sealed record, for ``ventbench board add``.
        """
        beside = folder / f"{canonical.digest(self.ciphertext)}{layout.SEALED_SUFFIX}"
        path = folder / f"{canonical.digest(self.content)}{layout.RECORD_SUFFIX}"
        files.write_atomically(beside, lambda file: file.write(self.ciphertext))
        files.write_atomically(path, lambda file: file.write(self.content))
        return path


@dataclass(frozen=True)
class Opened:
    """What was inside a sealed record.

    Attributes:
        record: the record.
        content: its bytes.
        commands: bytes of its action file.
    """

    record: Record
    content: bytes
    commands: bytes


def scores_of(score: Record) -> dict[str, float | None]:
    """What is published of a record's scores before it is opened: rounded means over everything."""
    means = {"score_cmh2o": float(score.by_draw.mean())}
    if score.headroom is not None:
        means["normalised"] = float(score.ranked_values.mean())
    if score.stress is not None:
        means["stress_cmh2o"] = score.stress.tables.score
    return {key: round(mean, DECIMALS) if mean == mean else None for key, mean in means.items()}


def seal(content: bytes, commands: bytes, season: Season, seed: bytes) -> SealedDraft:
    """Seal a record.

    Args:
        content: bytes of the record.
        commands: bytes of its action file.
        season: whose draws were used.
        seed: of the season.

    Raises:
        InputError: if it is not the record of a score of this season, the seed is not the
            season's, or there is no library to seal with.
    """
    seasons.require_seed(season, seed)
    score = record.from_bytes(content, "the record to be sealed")
    if not isinstance(score, Record):
        raise InputError("only the record of a score can be sealed")
    problems = _not_of_season(score, season)
    if problems:
        raise InputError(f"the record of {score.name} cannot be sealed: {'; '.join(problems)}")
    plain = _LENGTHS.pack(len(content), len(commands)) + content + commands
    plain += bytes(-len(plain) % _PAGE)
    ciphertext = _encrypted(plain, seed, _RECORD)
    values: dict[str, Any] = canonical.parse(content, "the record to be sealed")
    public = {key: values[key] for key in _COMMON}
    public |= {
        "kind": "sealed",
        "supersedes": values["supersedes"],
        "reason": values["reason"],
        "season": season.about(),
        "scores": scores_of(score),
        "complete": score.header.failed_cells == 0,
        "safe": all(score.header.safe),
        "record": score.sha256,
        "sealed": {
            "sha256": canonical.digest(ciphertext),
            "bytes": len(ciphertext),
            "encoding": "chacha20-poly1305",
        },
    }
    return SealedDraft(canonical.canonical(public), ciphertext)


def path_of(sealed: Sealed, folder: Path) -> Path:
    """Where the ciphertext of a sealed record lies."""
    return folder / f"{sealed.content.sealed.sha256}{layout.SEALED_SUFFIX}"


def load(sealed: Sealed, folder: Path) -> bytes:
    """Read the ciphertext of a sealed record.

    Args:
        sealed: whose it is.
        folder: that holds the file.

    Raises:
        InputError: if the file is missing, or not the one that the record names.
    """
    path = path_of(sealed, folder)
    if not path.is_file() or path.is_symlink():
        raise InputError(f"{path} is missing: the content of sealed record {sealed.sha256[:12]}")
    size = path.stat().st_size
    if size > MAX_BYTES or size != sealed.content.sealed.bytes:
        raise InputError(f"{path} has {size} bytes, not {sealed.content.sealed.bytes}")
    content = path.read_bytes()
    if canonical.digest(content) != sealed.content.sealed.sha256:
        raise InputError(f"{path} has been changed: its SHA-256 is {canonical.digest(content)}")
    return content


def unseal(sealed: Sealed, ciphertext: bytes, season: Season, seed: bytes) -> Opened:
    """Open a sealed record, and check that it holds what it said.

    Args:
        sealed: the record.
        ciphertext: of :func:`load`.
        season: that it names.
        seed: of the season.

    Raises:
        InputError: if it does not open, or says something else than the record inside.
    """
    seasons.require_seed(season, seed)
    label = f"sealed record {sealed.sha256}"
    problems = belongs(sealed, season)
    if problems:
        raise InputError(f"{label}: {'; '.join(problems)}")
    plain = _decrypted(ciphertext, seed, _RECORD, f"{label} of season {season.id}")
    if len(plain) < _LENGTHS.size:
        raise InputError(f"{label} holds no record")
    size, beyond = _LENGTHS.unpack_from(plain)
    content = plain[_LENGTHS.size : _LENGTHS.size + size]
    commands = plain[_LENGTHS.size + size : _LENGTHS.size + size + beyond]
    if (len(content), len(commands)) != (size, beyond):
        raise InputError(f"{label} is cut short inside")
    score = record.from_bytes(content, f"the record inside {label}")
    if not isinstance(score, Record):
        raise InputError(f"{label} holds no record of a score")
    problems = [*_not_of_season(score, season), *differences(sealed, score)]
    if canonical.digest(commands) != score.header.actions.sha256:
        problems.append("its commands are not those that the record inside names")
    if problems:
        raise InputError(f"{label}: {'; '.join(problems)}")
    return Opened(score, content, commands)


def belongs(sealed: Sealed, season: Season) -> list[str]:
    """What a sealed record says of its season that the season file does not; one sentence each."""
    said = msgspec.structs.asdict(sealed.content.season)
    problems = [
        f"key season.{key} is {said[key]}, the season file says {value}"
        for key, value in season.about().items()
        if said[key] != value
    ]
    if sealed.version != season.protocol:
        problems.append(f"key protocol is {sealed.version}, the season file says {season.protocol}")
    return problems


def differences(sealed: Sealed, score: Record) -> list[str]:
    """What a sealed record says otherwise than the record inside; one sentence each."""
    public, inside = sealed.content, score.header
    pairs = {
        "record": (public.record, score.sha256),
        "complete": (public.complete, inside.failed_cells == 0),
        "safe": (public.safe, all(inside.safe)),
        "scores": (public.scores, scores_of(score)),
        **{
            key: (getattr(public, key), getattr(inside, key))
            for key in _COMMON
            if key != "provenance"  # that of the sealed record may say more
        },
    }
    return [
        f"key {key} is not what the record inside says"
        for key, (said, true) in pairs.items()
        if said != true
    ]


def _not_of_season(score: Record, season: Season) -> list[str]:
    problems = []
    if score.version != season.protocol:
        problems.append(f"its protocol is {score.version}, that of the season {season.protocol}")
    if score.header.draws.count != season.draws:
        problems.append(f"it has {score.header.draws.count} draws, the season {season.draws}")
    # Protocol version 1 has published draws alone.
    if season.protocol > 1 and score.header.draws.sha256 != season.commitment:
        problems.append("its draws are not those of the season")
    return problems


def breaches(
    records: Sequence[AnyRecord], known: Mapping[str, Season], attested: Collection[str]
) -> dict[str, str]:
    """Find records of seasons that do not count, by the rules of their seasons.

    A run counts for each of its authors, in the calendar week (UTC, from Monday) in which it was
    scored, whether or not it was superseded or withdrawn later.

    Args:
        records: in the order of the chain.
        known: seasons by id.
        attested: hashes of the records that are signed or accepted; others count for nobody.

    Returns:
        By the hash of the sealed record, and by that of the record inside, why it is not official.
    """
    reasons: dict[str, str] = {}
    runs: Counter[tuple[str, str, tuple[int, int]]] = Counter()
    for sealed in records:
        if not isinstance(sealed, Sealed) or not sealed.official or sealed.sha256 not in attested:
            continue
        season = known.get(sealed.content.season.id)
        if season is None:
            continue  # its file is missing, which is a problem of its own
        day = scored_on(sealed)
        week = day.isocalendar()[:2]
        # Who names nobody shares the runs of all who do so.
        authors = {_author(name) for name in sealed.manifest.authors or [""]}
        for author in authors:
            runs[season.id, author, week] += 1
        most = max((runs[season.id, author, week] for author in authors), default=0)
        reason = ""
        if not season.opens <= day <= season.closes:
            reason = f"scored on {day}, outside the season {season.opens} to {season.closes}"
        elif most > season.runs_per_week:
            reason = (
                f"run {most} of its authors in week {week[1]} of {week[0]}; season {season.id} "
                f"allows {season.runs_per_week}"
            )
        if reason:
            reasons[sealed.sha256] = reasons[sealed.content.record] = f"not official: {reason}"
    return reasons


def scored_on(sealed: Sealed) -> date:
    """Day of the score, UTC."""
    return datetime.strptime(sealed.content.created, schema.TIME_FORMAT).date()


def _author(name: str) -> str:
    """One form for a name, however it is written: case, spaces, characters that are not seen."""
    seen = (c for c in unicodedata.normalize("NFKC", name) if unicodedata.category(c) != "Cf")
    return " ".join("".join(seen).casefold().split())


def seal_reference(path: Path, content: bytes, season: Season, seed: bytes) -> None:
    """Write the reference errors of a season, which tell its draws, encrypted.

    Args:
        path: of the file, :func:`reference_path`.
        content: of a file of :meth:`ventbench.headroom.reference.Reference.save`.
        season: whose draws were used.
        seed: of the season.

    Raises:
        InputError: if the seed is not the season's, there is a file already, or there is no library
            to encrypt with.
        OSError: if it cannot be written.
    """
    seasons.require_seed(season, seed)
    if path.exists():
        raise InputError(f"{path} exists; the reference errors of a season are never changed")
    ciphertext = _encrypted(content, seed, _REFERENCE)
    files.write_atomically(path, lambda file: file.write(ciphertext))


def open_reference(folder: Path, season: Season, seed: bytes) -> Reference:
    """Read the reference errors of a season.

    Args:
        folder: of the leaderboard.
        season: whose they are.
        seed: of the season.

    Raises:
        InputError: if the file is missing, or not one of this season.
    """
    from ventbench.headroom import reference

    seasons.require_seed(season, seed)
    path = reference_path(folder, season.id)
    if not path.is_file() or path.is_symlink() or path.stat().st_size > MAX_REFERENCE_BYTES:
        raise InputError(
            f"{path} is missing or no file of reference errors; make it with `ventbench headroom` "
            "and `ventbench board seal-reference`"
        )
    content = _decrypted(path.read_bytes(), seed, _REFERENCE, str(path))
    with tempfile.TemporaryDirectory() as private:
        plain = Path(private) / "reference.npz"
        plain.write_bytes(content)
        return reference.load(plain)


def other_reference(score: Record, reference: Reference) -> list[str]:
    """Reference errors of a record that are not those of its draws; one sentence each."""
    if score.headroom is None:
        return []
    tables = {"attainable": reference.attainable, "pid": reference.pid}
    return [
        f"key headroom.{key}: not the published reference errors"
        for key, table in tables.items()
        if not np.array_equal(getattr(score.headroom, key), np.moveaxis(table, 1, 0))
    ]


def reference_path(folder: Path, name: str) -> Path:
    """Where the reference errors of a season lie."""
    return folder / layout.SEASONS / f"{name}{layout.REFERENCE_SUFFIX}"


def _encrypted(plain: bytes, seed: bytes, purpose: bytes) -> bytes:
    salt = secrets.token_bytes(_SALT)
    return salt + _cipher(seed, salt).encrypt(bytes(12), plain, purpose)


def _decrypted(ciphertext: bytes, seed: bytes, purpose: bytes, label: str) -> bytes:
    salt, body = ciphertext[:_SALT], ciphertext[_SALT:]
    cipher = _cipher(seed, salt)
    try:
        return cipher.decrypt(bytes(12), body, purpose)
    except _invalid_tag():
        raise InputError(f"{label} does not open with this seed") from None


def _cipher(seed: bytes, salt: bytes) -> Any:
    try:
        from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
    except ImportError as error:
        raise InputError(
            "sealed records need cryptography: install ventbench[attest] "
            f"(pip install 'ventbench[attest]'); import failed with: {error}"
        ) from error
    # A key of its own for each record, so that its nonce may be zero.
    return ChaCha20Poly1305(seasons.derived_key(seed, f"sealed record {salt.hex()}"))


def _invalid_tag() -> type[Exception]:
    from cryptography.exceptions import InvalidTag

    return InvalidTag
