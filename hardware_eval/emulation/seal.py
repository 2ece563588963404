"""Seals: an answer is published encrypted, with its hash; the secret that made it opens it."""

from __future__ import annotations

import hashlib

import numpy as np

from ventbench.base.errors import InputError

#: Begins what random numbers are drawn from; another text would change every case ever sealed.
_FORMAT = "ventbench-challenge-1"


def random_generator(secret: str, *purpose: str) -> np.random.Generator:
    """Return random numbers that only the secret determines, different ones for each purpose."""
    text = "\n".join((_FORMAT, secret, *purpose))
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.default_rng(np.random.SeedSequence(int.from_bytes(digest, "big")))


def commitment(text: bytes) -> str:
    """SHA-256 of the plain answers, hexadecimal."""
    return hashlib.sha256(text).hexdigest()


def encrypt(text: bytes, secret: str, public: bytes) -> bytes:
    """Encrypt or decrypt with a key stream of SHA-256 blocks.

    Args:
        text: answers, plain or encrypted.
        secret: secret of the challenge.
        public: the public file of the cases, so that no key stream is used twice.
    """
    key = hashlib.sha256(public + b"\n" + secret.encode()).digest()
    blocks = range((len(text) + 31) // 32)
    stream = b"".join(hashlib.sha256(key + k.to_bytes(8, "big")).digest() for k in blocks)
    return bytes(a ^ b for a, b in zip(text, stream, strict=False))


def unseal(data: bytes, secret: str, public: bytes, published: str) -> bytes:
    """Decrypt the answers and check them against the published hash.

    Raises:
        InputError: if the secret is another one, or the answers are not those that were published.
    """
    text = encrypt(data, secret, public)
    if commitment(text) != published:
        raise InputError(
            f"this seed decrypts answers whose SHA-256 is {commitment(text)}, but {published} was "
            "published; give the seed that the challenge was made with, and its files unchanged"
        )
    return text
