"""A beacon of our own for rehearsals: a BLS key and the values that it signs."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

from ventbench.board import beacon
from ventbench.board.beacon import Chain

_LIMIT = sys.getrecursionlimit()

from py_ecc.bls import hash_to_curve, point_compression  # noqa: E402
from py_ecc.optimized_bls12_381 import optimized_curve as curve  # noqa: E402

sys.setrecursionlimit(_LIMIT)  # py_ecc raises it beyond what the stack holds


def chain(secret: int, *, genesis: int = 0, period: int = 1) -> Chain:
    """The chain of a secret key."""
    high, low = point_compression.compress_G2(curve.multiply(curve.G2, secret))
    public = high.to_bytes(48, "big") + low.to_bytes(48, "big")
    return Chain(public.hex(), genesis, period, hashlib.sha256(public).hexdigest())


def value(secret: int, number: int) -> bytes:
    """What the beacon publishes in a round, as relays do."""
    message = hashlib.sha256(number.to_bytes(8, "big")).digest()
    hashed = hash_to_curve.hash_to_G1(message, beacon.DOMAIN, hashlib.sha256)  # type: ignore[arg-type]
    point = point_compression.compress_G1(curve.multiply(hashed, secret))
    signature = point.to_bytes(48, "big")
    return json.dumps(
        {
            "round": number,
            "randomness": hashlib.sha256(signature).hexdigest(),
            "signature": signature.hex(),
        }
    ).encode()


if __name__ == "__main__":  # SECRET NUMBER FILE
    Path(sys.argv[3]).write_bytes(value(int(sys.argv[1]), int(sys.argv[2])))
