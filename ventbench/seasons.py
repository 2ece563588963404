"""Seasons of the leaderboard: draws that nobody knows before they are revealed.

The draws of a season follow from a secret seed of 32 bytes. Its commitment (a hash) is published
when the season opens, the seed itself when it closes: then everybody can make the same draws and
verify every score. Development draws come from a published seed through the same generator.

A season is a TOML file::

    id = "2027-spring"
    protocol = 2
    commitment = "4d1c..."      # of the secret seed
    draws = 20
    opens = 2027-03-01          # first and last day of scores, UTC
    closes = 2027-06-30
    runs_per_week = 3           # official scores of an author, in a week from Monday to Sunday
    seed = "9f0a..."            # only once it is revealed
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import tomllib
from datetime import date
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ventbench import files
from ventbench.errors import InputError

#: Bytes of a seed: as many as the hash has, so that guessing is hopeless.
SEED_BYTES = 32

#: Seed of the development draws. It is published, so nobody can have chosen it: a hash of its name.
DEVELOPMENT_SEED = hashlib.sha256(b"ventbench development draws").digest()

#: Name of the development draws; no season may have it.
DEVELOPMENT = "development"

#: Largest season file, bytes.
MAX_BYTES = 10_000

# They stand before what is hashed, so that no hash of one use is also one of another use.
_STREAM = b"ventbench uniforms 1\n"
_COMMITMENT = b"ventbench season 1\n"
_KEY = b"ventbench key 1\n"

_Hex32 = Annotated[str, msgspec.Meta(pattern=r"\A[0-9a-f]{64}\Z")]
_Id = Annotated[str, msgspec.Meta(pattern=r"\A[a-z0-9][a-z0-9-]{0,39}\Z")]
_Number = Annotated[int, msgspec.Meta(ge=1, le=1000)]


class Season(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A season; make one with :func:`read_season` or :func:`new_season`, which validate.

    Attributes:
        id: name of its file, without the ending.
        protocol: version of the protocol that it is scored by.
        commitment: hash of the secret seed, 64 hexadecimal digits.
        draws: number of hidden draws.
        opens: first day on which a score counts, UTC.
        closes: last day on which a score counts, UTC.
        runs_per_week: official scores that an author may have in a calendar week.
        seed: 64 hexadecimal digits, or None while it is secret.
    """

    id: _Id
    protocol: _Number
    commitment: _Hex32
    draws: _Number
    opens: date
    closes: date
    runs_per_week: _Number
    seed: _Hex32 | None = None

    @property
    def revealed(self) -> bytes | None:
        """The seed, if it is public."""
        return None if self.seed is None else bytes.fromhex(self.seed)

    def about(self) -> dict[str, Any]:
        """Name, commitment and number of draws, for records."""
        return {"id": self.id, "commitment": self.commitment, "draws": self.draws}


def uniforms(seed: bytes, label: str, shape: int | tuple[int, ...]) -> NDArray[np.float64]:
    r"""Uniform numbers that follow from a seed and a label, the same on every machine.

    Block ``k = 0, 1, ...`` of the stream is HMAC-SHA256, with the seed as its key, of
    ``b"ventbench uniforms 1\n"``, the label in UTF-8, and ``k`` in 8 bytes, most significant first.
    A block gives four numbers of 8 bytes, most significant first. The upper 52 bits ``n`` of one
    give ``(n + 1/2) / 2**52``, which float64 represents exactly. Numbers of different labels tell
    nothing about each other, and none of them about the seed.

    Args:
        seed: 32 bytes.
        label: what the numbers are for.
        shape: of the result; a longer shape begins with the same numbers.

    Returns:
        Numbers greater than 0 and less than 1 in row-major order, all multiples of 2**-53.

    Raises:
        InputError: if the seed does not have 32 bytes.
    """
    _check_length(seed)
    lengths = (shape,) if isinstance(shape, int) else tuple(shape)
    size = int(np.prod(lengths, dtype=np.int64))
    prefix = _STREAM + label.encode()
    blocks = b"".join(
        hmac.digest(seed, prefix + k.to_bytes(8, "big"), "sha256") for k in range(-(-size // 4))
    )
    words = np.frombuffer(blocks, ">u8", count=size).astype(np.uint64)
    return ((words >> np.uint64(12)).astype(np.float64) + 0.5).reshape(lengths) * 2.0**-52


def derived_key(seed: bytes, label: str) -> bytes:
    """32 bytes that follow from a seed and a label, for ciphers; they tell nothing about either."""
    _check_length(seed)
    return hmac.digest(seed, _KEY + label.encode(), "sha256")


def commitment(seed: bytes) -> str:
    r"""Hash that binds whoever publishes it to a seed without telling the seed.

    It is SHA-256 of ``b"ventbench season 1\n"`` and the seed, as 64 hexadecimal digits.

    Raises:
        InputError: if the seed does not have 32 bytes.
    """
    _check_length(seed)
    return hashlib.sha256(_COMMITMENT + seed).hexdigest()


def new_season(
    *,
    id: str,
    protocol: int,
    draws: int,
    opens: date,
    closes: date,
    runs_per_week: int,
) -> tuple[Season, bytes]:
    """Make a season with a fresh secret seed from the system's random numbers.

    Args:
        id: lower-case letters, digits and hyphens.
        protocol: version of the protocol.
        draws: number of hidden draws, 1..1000.
        opens: first day, UTC.
        closes: last day, UTC.
        runs_per_week: official scores of an author in a calendar week, 1..1000.

    Returns:
        The season, and its seed.

    Raises:
        InputError: if a value is not valid.
    """
    seed = secrets.token_bytes(SEED_BYTES)
    values = {
        "id": id,
        "protocol": protocol,
        "commitment": commitment(seed),
        "draws": draws,
        "opens": opens,
        "closes": closes,
        "runs_per_week": runs_per_week,
    }
    return _validated(values, f"season {id}"), seed


def read_season(path: Path) -> Season:
    """Read and validate a season file.

    Raises:
        InputError: if it is missing, too large, a link, not such a file, or its seed is not the
            one of its commitment.
    """
    if path.is_symlink() or not path.is_file():
        raise InputError(f"{path} is missing, or is not a plain file")
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path} is larger than {MAX_BYTES} bytes")
    try:
        values = tomllib.loads(path.read_bytes().decode("utf-8"))
    except (ValueError, RecursionError) as error:  # not UTF-8, or not TOML
        raise InputError(f"{path}: {error}") from None
    season = _validated(values, str(path))
    if path.stem != season.id:
        raise InputError(f"{path}, key id: {season.id!r} is not the name of the file")
    return season


def write_season(path: Path, season: Season) -> None:
    """Write a season file.

    Raises:
        OSError: if it cannot be written.
    """
    import tomli_w

    values = {k: v for k, v in msgspec.structs.asdict(season).items() if v is not None}
    files.write_text(path, tomli_w.dumps(values))


def reveal(season: Season, seed: bytes) -> Season:
    """Return the season with its seed.

    Raises:
        InputError: if the seed is not the one of the commitment.
    """
    require_seed(season, seed)
    return msgspec.structs.replace(season, seed=seed.hex())


def require_seed(season: Season, seed: bytes) -> None:
    """Check that a seed is the one of the season's commitment.

    Raises:
        InputError: if it is not; the message does not hold the seed.
    """
    if commitment(seed) != season.commitment:
        raise InputError(
            f"season {season.id}: this seed is not the one of its commitment "
            f"{season.commitment[:12]}; take the seed file that was written with the season"
        )


def write_seed(path: Path, seed: bytes) -> None:
    """Write a secret seed to a new file that only its owner may read.

    Raises:
        InputError: if there is a file already.
        OSError: if it cannot be written.
    """
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except FileExistsError:
        raise InputError(f"{path} exists; a seed is never overwritten") from None
    with os.fdopen(handle, "w") as file:
        file.write(seed.hex() + "\n")


def read_seed(path: Path) -> bytes:
    """Read a file of :func:`write_seed`.

    Raises:
        InputError: if it holds no seed, or others than its owner may read it.
        OSError: if it cannot be read.
    """
    with open(path, "rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        text = file.read(200)
    if mode & 0o077:
        raise InputError(f"{path} can be read by others (mode {mode & 0o777:o}); chmod 600 {path}")
    return parse_seed(text.decode("ascii", "replace"), str(path))


def parse_seed(text: str, label: str) -> bytes:
    """Seed of 64 hexadecimal digits.

    Raises:
        InputError: if the text is none; the message does not hold it.
    """
    try:
        seed = bytes.fromhex(text.strip())
    except ValueError:
        seed = b""
    if len(seed) != SEED_BYTES:
        raise InputError(f"{label} does not hold a seed of {2 * SEED_BYTES} hexadecimal digits")
    return seed


def _validated(values: dict[str, Any], label: str) -> Season:
    try:
        season = msgspec.convert(values, Season)
    except msgspec.ValidationError as error:
        raise InputError(f"{label}: {error}") from None
    if season.id == DEVELOPMENT:
        raise InputError(f"{label}, key id: {DEVELOPMENT} is the name of the published draws")
    if season.closes < season.opens:
        raise InputError(f"{label}, key closes: {season.closes} is before {season.opens}")
    if season.revealed is not None:
        require_seed(season, season.revealed)
    return season


def _check_length(seed: bytes) -> None:
    if len(seed) != SEED_BYTES:
        raise InputError(f"a seed has {SEED_BYTES} bytes; this one has {len(seed)}")
