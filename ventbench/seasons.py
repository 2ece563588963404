"""Numbers that follow from a seed, the same on every machine: draws anybody can make again."""

from __future__ import annotations

import hashlib
import hmac

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError

#: Bytes of a seed: as many as the hash has, so that guessing is hopeless.
SEED_BYTES = 32

#: Seed of the development draws. It is published, so nobody can have chosen it: a hash of its name.
DEVELOPMENT_SEED = hashlib.sha256(b"ventbench development draws").digest()

# They stand before what is hashed, so that no hash of one use is also one of another use.
_STREAM = b"ventbench uniforms 1\n"
_COMMITMENT = b"ventbench season 1\n"


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


def commitment(seed: bytes) -> str:
    r"""Hash that binds whoever publishes it to a seed without telling the seed.

    It is SHA-256 of ``b"ventbench season 1\n"`` and the seed, as 64 hexadecimal digits.

    Raises:
        InputError: if the seed does not have 32 bytes.
    """
    _check_length(seed)
    return hashlib.sha256(_COMMITMENT + seed).hexdigest()


def _check_length(seed: bytes) -> None:
    if len(seed) != SEED_BYTES:
        raise InputError(f"a seed has {SEED_BYTES} bytes; this one has {len(seed)}")
