r"""A public randomness beacon: which value a round must take, and whether it is genuine.

The League of Entropy's network *quicknet* publishes a BLS signature of each round number every
three seconds (scheme ``bls-unchained-g1-rfc9380``). Its key is shared among many organisations, so
that none of them can know a value beforehand or choose it, and anybody checks it offline:

.. math:: e(\sigma, g_2) = e(H(\mathrm{SHA256}(n)), K), \qquad \text{randomness} =
    \mathrm{SHA256}(\sigma)

for the signature in G1, the key in G2, and the round number in 8 bytes, most significant first.
"""

from __future__ import annotations

import functools
import hashlib
import hmac
import json
import math
import sys
import urllib.request
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec

from ventbench.base.errors import InputError, require
from ventbench.board import schema

#: Domain of the hash to the curve (RFC 9380).
DOMAIN = b"BLS_SIG_BLS12381G1_XMD:SHA-256_SSWU_RO_NUL_"

#: Where values of quicknet are published; its signature says whether the answer is genuine.
RELAYS = (
    "https://api.drand.sh",
    "https://api2.drand.sh",
    "https://api3.drand.sh",
    "https://drand.cloudflare.com",
)

_MAX_BYTES, _TIMEOUT_S = 10_000, 20.0

_PURPOSE = b"ventbench round 1\n"


class Chain(schema.Table, frozen=True):
    """A beacon: its key in G2, compressed, and the time of round 1 and between rounds, s."""

    public_key: Annotated[str, schema.matching("[0-9a-f]{192}")]
    genesis: Annotated[int, msgspec.Meta(ge=0, le=2**40)]
    period: Annotated[int, msgspec.Meta(ge=1, le=10**6)]
    hash: schema.Sha256

    def first_at(self, when: datetime, delay_s: int = 0) -> int:
        """Number of the first round at or after a time and a delay."""
        waited_s = when.timestamp() + delay_s - self.genesis
        return max(1, math.ceil(waited_s / self.period) + 1)

    def time_of(self, number: int) -> datetime:
        """When a round is published."""
        return datetime.fromtimestamp(self.genesis + (number - 1) * self.period, UTC)


#: The chain of official rounds; the hash is that of its parameters, and names it everywhere.
QUICKNET = Chain(
    "83cf0f2896adee7eb8b5f01fcad3912212c437e0073e911fb90022d3e760183c8c4b450b6a0a6c3ac6a5776a2d1064510d"
    "1fec758c921cc22b0e17e63aaf4bcb5ed66304de9cf809bd274ca73bab4af5a6e9c76a4bc09e76eae8991ef5ece45a",
    genesis=1692803367,
    period=3,
    hash="52db9ba70e0cc0f6eaf7803dd07447a1f5477735fd3f661792ba94600c84e971",
)


class Value(schema.Table, frozen=True):
    """What a beacon published in one round."""

    round: Annotated[int, msgspec.Meta(ge=1, lt=2**53)]
    randomness: schema.Sha256
    signature: Annotated[str, schema.matching("[0-9a-f]{96}")]

    def seed(self, frozen: str) -> bytes:
        """Seed of what is drawn, by the SHA-256 of the file that says what was frozen before."""
        key = bytes.fromhex(self.randomness)
        return hmac.digest(key, _PURPOSE + bytes.fromhex(frozen), "sha256")


def read(content: bytes, label: str) -> Value:
    """Read a value as relays publish it; InputError if it is none.

    Version 2 of their interface leaves the randomness out, as it follows from the signature.
    """
    try:
        published = json.loads(content)
        published.setdefault("randomness", _randomness(published["signature"]))
        content = json.dumps(published).encode()
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        pass  # the decoder says what is wrong
    return schema.decoded(Value, content, label)


def _randomness(signature: str) -> str:
    return hashlib.sha256(bytes.fromhex(signature)).hexdigest()


def take(content: bytes, chain: Chain, number: int, now: datetime | None = None) -> Value:
    """Take the value of a round, as relays publish it; ``now`` is the clock's if not given.

    Raises:
        InputError: if its time has not come, or it is not that value.
    """
    due = chain.time_of(number)
    if (now or datetime.now(UTC)) < due:
        raise InputError(f"round {number} of the beacon is published at {due:%F %T} UTC")
    value = read(content, "the value of the beacon")
    check(value, chain, number, "the value of the beacon")
    return value


def fetch(chain: Chain, number: int) -> bytes:
    """Get a value from the first public relay that answers; InputError if none does."""
    silent = []
    for relay in RELAYS:
        try:
            address = f"{relay}/{chain.hash}/public/{number}"
            with urllib.request.urlopen(address, timeout=_TIMEOUT_S) as answer:
                return answer.read(_MAX_BYTES)
        except (OSError, ValueError) as error:
            silent.append(f"{relay} ({error})")
    raise InputError(
        f"no relay answers: {', '.join(silent)}; get the value of round {number} from any other "
        "and give it with --beacon FILE"
    )


def check(value: Value, chain: Chain, number: int, label: str) -> None:
    """Check that a value is that of a round, signed by the beacon; ``label`` names it in messages.

    Raises:
        InputError: if it is of another round or not genuine, or there is no library to check it.
    """
    if value.round != number:
        raise InputError(
            f"{label}, key round: is {value.round}, and must be {number}, the first after the "
            "freeze and the delay"
        )
    if _randomness(value.signature) != value.randomness:
        raise InputError(f"{label}, key randomness: is not the SHA-256 of the signature")
    if not _genuine(value.signature, chain.public_key, value.round):
        raise InputError(f"{label}, key signature: is not by key {chain.public_key[:16]}")


@functools.lru_cache(maxsize=64)
def _genuine(signature: str, key: str, number: int) -> bool:
    """Whether both sides of the pairing agree; all points must lie in their groups."""
    limit = sys.getrecursionlimit()
    try:
        require("py_ecc", extra="rounds", what="values of a beacon")
        from py_ecc import optimized_bls12_381
        from py_ecc.bls import hash_to_curve, point_compression
        from py_ecc.bls.typing import G1Compressed, G2Compressed
    finally:  # py_ecc raises it so far that deep JSON of a stranger would end the process
        sys.setrecursionlimit(limit)
    curve: Any = optimized_bls12_381
    sha256: Any = hashlib.sha256
    halves = int(key[:96], 16), int(key[96:], 16)
    try:
        signed = point_compression.decompress_G1(G1Compressed(int(signature, 16)))
        public = point_compression.decompress_G2(G2Compressed(halves))
    except ValueError:  # no point of the curve
        return False
    points = (signed, public)
    if any(
        curve.is_inf(x) or not curve.is_inf(curve.multiply(x, curve.curve_order)) for x in points
    ):
        return False
    message = hashlib.sha256(number.to_bytes(8, "big")).digest()
    hashed = hash_to_curve.hash_to_G1(message, DOMAIN, sha256)
    product = curve.pairing(curve.G2, signed, final_exponentiate=False) * curve.pairing(
        public, curve.neg(hashed), final_exponentiate=False
    )
    return curve.final_exponentiate(product) == curve.FQ12.one()


def chain_of(path: Path) -> Chain:
    """Read the chain of a referee, for a rehearsal: JSON with the keys of :class:`Chain`.

    Raises:
        InputError: if it is none.
    """
    try:
        return msgspec.convert(json.loads(path.read_text("utf-8")), Chain)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} describes no beacon: {error}") from None
