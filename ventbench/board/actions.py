"""Every command of a scored run in one file, bit for bit, and that it is the right file.

The file is zlib over byte planes: the first bytes of all little-endian float64 numbers, then their
second bytes, and so on; sign and exponent then compress, the noisy mantissa does not. In numpy::

    planes = np.frombuffer(zlib.decompress(content), np.uint8).reshape(8, -1)
    requested = planes.T.copy().view("<f8").reshape(shape)
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.board import canonical
from ventbench.task import protocol

#: How the bytes are laid out; written into the record.
ENCODING = "zlib, byte planes of little-endian float64"

#: End of the file's name, after its SHA-256.
SUFFIX = canonical.ACTIONS_SUFFIX

#: Largest file, bytes: float64 noise does not compress, but hardly grows.
MAX_BYTES = 2_000_000


def encode(requested: Floats) -> bytes:
    """Return the content of the file.

    Args:
        requested: %, any shape, finite.

    Raises:
        ValueError: if a command is not finite.
    """
    if not np.all(np.isfinite(requested)):
        raise ValueError("a command is not finite")
    numbers: Any = np.ascontiguousarray(requested, "<f8")
    planes = numbers.view(np.uint8).reshape(-1, 8).T
    return zlib.compress(np.ascontiguousarray(planes).tobytes(), 6)


def decode(content: bytes, shape: Sequence[int], label: str) -> Floats:
    """Return the commands, %, in their shape.

    Never takes more memory than the shape says, whatever the content is.

    Args:
        content: of the file.
        shape: that the record states.
        label: names the file in messages.

    Raises:
        InputError: if the content is not such a file of this shape.
    """
    size = 8 * int(np.prod(shape, dtype=np.int64))
    inflate = zlib.decompressobj()
    try:
        raw = inflate.decompress(content, size + 1)
    except zlib.error as error:
        raise InputError(f"{label} is not an action file: {error}") from None
    if len(raw) != size or not inflate.eof or inflate.unused_data:
        raise InputError(f"{label} does not hold commands of shape {tuple(shape)}")
    planes = np.frombuffer(raw, np.uint8).reshape(8, -1)
    values: Any = np.ascontiguousarray(planes.T)
    requested = values.view("<f8").reshape(tuple(shape)).astype(np.float64)
    if not np.all(np.isfinite(requested)):
        raise InputError(f"{label} holds a command that is not finite")
    return requested


def shape(lungs: int, draws: int, pips: int) -> tuple[int, int, int, int, int]:
    """Shape of the commands of a score: ``(L, 1 + K, P, BREATHS, INSPIRATION)``."""
    return lungs, 1 + draws, pips, protocol.BREATHS, protocol.INSPIRATION_STEPS
