"""Seals of answers: published encrypted, with their hash; the secret that made them opens them."""

from __future__ import annotations

import hashlib

from ventbench.base.errors import InputError


def commitment(text: bytes) -> str:
    """SHA-256 of the plain answers, hexadecimal."""
    return hashlib.sha256(text).hexdigest()


def encrypt(text: bytes, secret: str, public: bytes) -> bytes:
    """Encrypt or decrypt answers with a key stream of SHA-256 blocks, from the secret.

    It also depends on the public file of the cases, so that no key stream is used twice.
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
