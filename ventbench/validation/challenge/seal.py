"""Answers under seal: encrypted with the secret, their hash published before anyone looks."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any

import numpy as np

from ventbench.errors import InputError
from ventbench.validation.challenge.cases import Base, Case, Effect
from ventbench.validation.challenge.plan import Drawn

_FORMAT = "ventbench-challenge-1"


def generator(secret: str, *purpose: str) -> np.random.Generator:
    """Random numbers that nobody knows without the secret; other ones for each purpose."""
    text = "\n".join((_FORMAT, secret, *purpose))
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.default_rng(np.random.SeedSequence(int.from_bytes(digest, "big")))


def plain(secret: str, drawn: list[Drawn], nats: list[list[float]]) -> bytes:
    """Text of the answers, with a number that keeps them from being guessed by their hash.

    Args:
        secret: of the challenge.
        drawn: its cases.
        nats: what each effect of each is worth, from :func:`~.detect.nats`.
    """
    cases = [
        {"kind": item.kind, "nats": worth, "case": asdict(item.case)}
        for item, worth in zip(drawn, nats, strict=True)
    ]
    nonce = generator(secret, "nonce").bytes(32).hex()
    value = {"format": _FORMAT, "nonce": nonce, "cases": cases}
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def parse(text: bytes) -> list[tuple[Drawn, list[float]]]:
    """Cases and worths of effects, out of the text of the answers."""
    value = json.loads(text)
    return [
        (Drawn(item["kind"], _case(item["case"])), [float(x) for x in item["nats"]])
        for item in value["cases"]
    ]


def commitment(text: bytes) -> str:
    """SHA-256 of the answers, hexadecimal."""
    return hashlib.sha256(text).hexdigest()


def sealed(text: bytes, secret: str, public: bytes) -> bytes:
    """Encrypt or decrypt: the text against a stream of SHA-256.

    Args:
        text: answers, plain or sealed.
        secret: of the challenge.
        public: what is known of it, so that no stream is used twice.
    """
    key = hashlib.sha256(public + b"\n" + secret.encode()).digest()
    blocks = range((len(text) + 31) // 32)
    stream = b"".join(hashlib.sha256(key + k.to_bytes(8, "big")).digest() for k in blocks)
    return bytes(a ^ b for a, b in zip(text, stream, strict=False))


def opened(data: bytes, secret: str, public: bytes, promised: str) -> bytes:
    """Open the seal.

    Raises:
        InputError: if the secret is another one, or the answers are not those that were promised.
    """
    text = sealed(data, secret, public)
    if commitment(text) != promised:
        raise InputError(
            f"what this seed opens has the SHA-256 {commitment(text)}, but {promised} was "
            "published; give the seed that the challenge was made with, and its files unchanged"
        )
    return text


def _case(value: dict[str, Any]) -> Case:
    effects = tuple(Effect(**item) for item in value["effects"])
    base = None if value["base"] is None else Base(**value["base"])
    return Case(**(value | {"effects": effects, "base": base}))
