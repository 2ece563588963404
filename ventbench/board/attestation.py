"""Who vouches for a record: signatures by keys of the leaderboard, and the maintainers' list.

Replay proves that a record's errors follow from its commands, and nothing about who computed the
commands. Somebody vouches for a record if

- ``records/HASH.sig`` holds an Ed25519 signature over its hash by a key of the leaderboard, or
- the maintainers name it among the official second runs, with what they saw and a date; or, for
  a hardware record, among the bench logs, with the hash of the raw recording.

Keys, second runs and bench logs stand in ``attestations.toml``, which reviewed commits alone
change, and never together with records. The signature is made in a job that has run no code of a
submission; see ``ci/propose.py``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from ventbench.base import files
from ventbench.base.errors import InputError, require
from ventbench.board import canonical, schema
from ventbench.board.canonical import ATTESTATIONS, RECORDS, SIGNATURE_SUFFIX

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

#: Environment variable with the secret key: 64 hexadecimal digits.
SECRET = "VENTBENCH_SIGNING_KEY"

#: Stands before the hash in what is signed, so that no signature of other use fits.
_PURPOSE = b"ventbench record 1\n"

#: Largest list, bytes.
_MAX_LIST_BYTES = 1_000_000

_Hex32 = Annotated[str, schema.matching("[0-9a-f]{64}")]
_KeyId = Annotated[str, schema.matching("[0-9a-f]{16}")]


class Key(schema.Table, frozen=True):
    """A public key that may sign; ``id`` is the beginning of its SHA-256."""

    id: _KeyId
    public: _Hex32
    added: date
    holder: schema.Text


class SecondRun(schema.Table, frozen=True):
    """A record whose code the maintainers ran again, and what they saw."""

    record: schema.Sha256
    reason: schema.Reason
    date: date


class BenchLog(schema.Table, frozen=True):
    """A hardware record that the maintainers saw made, or whose raw recording they have read."""

    record: schema.Sha256
    recording: schema.Sha256
    witness: schema.Reason
    date: date


class Attestations(schema.Table, frozen=True):
    """Content of ``attestations.toml``."""

    keys: list[Key] = msgspec.field(default_factory=list)
    second_runs: list[SecondRun] = msgspec.field(default_factory=list)
    bench_logs: list[BenchLog] = msgspec.field(default_factory=list)


class _Signature(schema.Table, frozen=True):
    """Content of ``records/HASH.sig``."""

    key: _KeyId
    record: schema.Sha256
    signature: Annotated[str, schema.matching("[0-9a-f]{128}")]


def attested(folder: Path, records: Mapping[str, str | None]) -> tuple[frozenset[str], list[str]]:
    """Find what somebody who may do so vouches for: records, withdrawals, results and notes.

    Args:
        folder: of the leaderboard.
        records: SHA-256 of all of its records, and for hardware ones that of the raw recording.

    Returns:
        Hashes of the files that are signed or listed, and of hardware records with a bench log; and
        a sentence for each signature or line of the list that is wrong.

    Raises:
        InputError: if there are signatures and no library to check them with.
    """
    vouched: set[str] = set()
    problems: list[str] = []
    listed, path = Attestations(), folder / ATTESTATIONS
    try:
        listed = read_list(folder)
    except InputError as error:
        problems.append(str(error))
    keys = {key.id: key for key in listed.keys}
    problems += [
        f"{path}: key {key.id} should have the id {own}"
        for key in listed.keys
        if key.id != (own := key_id(bytes.fromhex(key.public)))
    ]
    for entry in listed.second_runs:
        if entry.record not in records:
            problems.append(f"{path}: record {entry.record} is not there")
        elif records[entry.record] is not None:
            problems.append(f"{path}: record {entry.record} was measured: it needs a bench log")
        else:
            vouched.add(entry.record)
    for log in listed.bench_logs:
        if records.get(log.record) != log.recording:
            problems.append(f"{path}: record {log.record} is not of recording {log.recording[:12]}")
        else:
            vouched.add(log.record)
    signed = {sha256: folder / RECORDS / f"{sha256}{canonical.RECORD_SUFFIX}" for sha256 in records}
    signed |= {files.sha256(path): path for path in statements(folder)}
    for sha256, file in signed.items():
        path = signature_path(file)
        if not path.exists():
            continue
        try:
            check_signature(path, sha256, keys)
            if records.get(sha256) is None:  # no key has seen a bench
                vouched.add(sha256)
        except InputError as error:
            problems.append(str(error))
    return frozenset(vouched), problems


def statements(folder: Path) -> list[Path]:
    """Files of a leaderboard that nothing binds but a signature: lists, results and notes."""
    matches = (path for name in canonical.SIGNED for path in sorted(folder.glob(name)))
    plain = (path for path in matches if path.is_file() and not path.is_symlink())
    return [path for path in plain if path.stat().st_size <= schema.MAX_BYTES]


def check_signature(path: Path, sha256: str, keys: dict[str, Key]) -> None:
    """Check the signature of a file, named by its SHA-256, by one of some keys, by id.

    Raises:
        InputError: if it is not such a signature, or there is no library to check it with.
    """
    signature = schema.read_canonical(_Signature, path)
    if signature.record != sha256:
        raise InputError(f"{path} signs another file, {signature.record[:12]}")
    key = keys.get(signature.key)
    if key is None:
        raise InputError(f"{path}: key {signature.key} is not in {ATTESTATIONS}")
    ed25519, invalid = _library()
    public = ed25519.Ed25519PublicKey.from_public_bytes(bytes.fromhex(key.public))
    try:
        public.verify(bytes.fromhex(signature.signature), _message(sha256))
    except invalid:
        raise InputError(f"{path}: the signature is not by key {key.id}") from None


def sign(folder: Path, signed: Path, secret: str) -> Path:
    """Sign a file of a leaderboard by a secret, 64 hexadecimal digits; return the path.

    Raises:
        InputError: if the secret is not a key, its public key is not one of the leaderboard's, or
            there is no library to sign with.
    """
    private = _private(secret)
    public = private.public_key().public_bytes_raw()
    keys = {key.id: key for key in read_list(folder).keys}
    key = keys.get(key_id(public))
    if key is None or key.public != public.hex():
        where = folder / ATTESTATIONS
        raise InputError(f"the public key of {SECRET}, {key_id(public)}, is not in {where}")
    sha256 = files.sha256(signed)
    signature = private.sign(_message(sha256)).hex()
    content = canonical.canonical({"key": key.id, "record": sha256, "signature": signature})
    path = signature_path(signed)
    files.write_bytes(path, content)
    return path


def new_key() -> tuple[str, str]:
    """Make a key: its secret, 64 hexadecimal digits, and the lines for ``attestations.toml``.

    Raises:
        InputError: if there is no library to make one with.
    """
    ed25519, _ = _library()
    private = ed25519.Ed25519PrivateKey.generate()
    public = private.public_key().public_bytes_raw()
    lines = (
        f'[[keys]]\nid = "{key_id(public)}"\npublic = "{public.hex()}"\n'
        f'added = {date.today().isoformat()}\nholder = "the workflow round"\n'
    )
    return private.private_bytes_raw().hex(), lines


def key_id(public: bytes) -> str:
    """Short name of a public key: the beginning of its SHA-256."""
    return hashlib.sha256(public).hexdigest()[:16]


def signature_path(signed: Path) -> Path:
    """Where the signature of a file lies."""
    return signed.with_suffix(SIGNATURE_SUFFIX)


def _message(sha256: str) -> bytes:
    return _PURPOSE + sha256.encode("ascii") + b"\n"


def _private(secret: str) -> Ed25519PrivateKey:
    ed25519, _ = _library()
    try:
        return ed25519.Ed25519PrivateKey.from_private_bytes(bytes.fromhex(secret.strip()))
    except ValueError:  # its text is a secret and must not be in the message
        raise InputError(f"{SECRET} is not a key of 64 hexadecimal digits") from None


def _library() -> tuple[Any, type[Exception]]:
    """The module of Ed25519 and its error of a wrong signature."""
    require("cryptography", extra="attest", what="signatures of records")
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric import ed25519

    return ed25519, InvalidSignature


def read_list(folder: Path) -> Attestations:
    """Read keys and second runs of a leaderboard; empty where there is no file.

    Raises:
        InputError: if it is not such a file.
    """
    path = folder / ATTESTATIONS
    return (
        schema.read_toml(path, Attestations, _MAX_LIST_BYTES) if path.exists() else Attestations()
    )
