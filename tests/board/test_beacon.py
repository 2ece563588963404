"""Values of a randomness beacon: known ones pass, anything else does not."""

from __future__ import annotations

import hashlib
import io
import json
import subprocess
import sys
from datetime import UTC, datetime

import msgspec
import pytest

from ventbench.base.errors import InputError
from ventbench.board import beacon
from ventbench.board.beacon import QUICKNET, Value

from . import referee

#: A published value of quicknet.
KNOWN = Value(
    657413,
    "fc1873a13f3545aeade8401532ef5519920652eee6b0d2b19ca12643b87b3587",
    "b713718a38ae728dfd477991af2822e08d2f305e47718cef9f7848ce4050e7be"
    "41076862b98fad56e91a6b85b89cd97b",
)


def test_a_published_value_is_genuine() -> None:
    beacon.check(KNOWN, QUICKNET, 657413, "the value")


@pytest.mark.parametrize("keys", [("round", "randomness", "signature"), ("round", "signature")])
def test_both_versions_of_the_relays_json_are_read(keys: tuple[str, ...]) -> None:
    published = {key: getattr(KNOWN, key) for key in keys}
    assert beacon.read(json.dumps(published).encode(), "the value") == KNOWN


@pytest.mark.parametrize("content", [b"[]", b"{", b'{"round": 1}', b'{"round": 1, "signature": 2}'])
def test_what_is_no_value_is_refused(content: bytes) -> None:
    with pytest.raises(InputError, match="the value"):
        beacon.read(content, "the value")


def test_the_next_relay_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def answer(address: str, timeout: float) -> io.BytesIO:
        asked.append(address)
        if len(asked) < 3:
            raise OSError("down")
        return io.BytesIO(b"{}")

    monkeypatch.setattr(beacon.urllib.request, "urlopen", answer)
    assert beacon.fetch(QUICKNET, 9) == b"{}"
    assert [address.rpartition(f"/{QUICKNET.hash}/public/9")[0] for address in asked] == list(
        beacon.RELAYS[:3]
    )
    monkeypatch.setattr(beacon, "RELAYS", beacon.RELAYS[:1])
    asked.clear()
    with pytest.raises(InputError, match=r"down.*--beacon FILE"):
        beacon.fetch(QUICKNET, 9)


def test_checking_leaves_python_able_to_refuse_deep_json() -> None:
    code = (
        "import sys; limit = sys.getrecursionlimit()\n"
        "from ventbench.board import beacon\n"
        f"beacon.check(beacon.{KNOWN}, beacon.QUICKNET, 657413, 'it')\n"
        "assert sys.getrecursionlimit() == limit"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_pinned_key_is_that_of_the_chains_hash() -> None:
    # What drand hashes: period, genesis, key, hash of the first group, name of the beacon.
    group = bytes.fromhex("f477d5c89f21a17c863a7f937c6a6d15859414d2be09cd448d4279af331c5d3e")
    parts = QUICKNET.period.to_bytes(4, "big") + QUICKNET.genesis.to_bytes(8, "big")
    parts += bytes.fromhex(QUICKNET.public_key) + group + b"quicknet"
    assert hashlib.sha256(parts).hexdigest() == QUICKNET.hash


def test_another_signature_is_refused() -> None:
    chain = referee.chain(5)
    other = beacon.read(referee.value(6, 10), "the value")
    with pytest.raises(InputError, match="key signature"):
        beacon.check(other, chain, 10, "the value")
    beacon.check(beacon.read(referee.value(5, 10), "the value"), chain, 10, "the value")


def test_another_round_or_randomness_is_refused() -> None:
    with pytest.raises(InputError, match="must be 657414"):
        beacon.check(KNOWN, QUICKNET, 657414, "the value")
    # The signature of one round under the number of another.
    moved = msgspec.structs.replace(KNOWN, round=657414)
    with pytest.raises(InputError, match="key signature"):
        beacon.check(moved, QUICKNET, 657414, "the value")
    with pytest.raises(InputError, match="key randomness"):
        beacon.check(msgspec.structs.replace(KNOWN, randomness="0" * 64), QUICKNET, 657413, "it")


@pytest.mark.parametrize("signature", ["c0" + "00" * 47, "ff" * 48, "00" * 48])
def test_what_is_no_point_of_the_group_is_refused(signature: str) -> None:
    randomness = hashlib.sha256(bytes.fromhex(signature)).hexdigest()
    with pytest.raises(InputError, match="key signature"):
        beacon.check(Value(1, randomness, signature), QUICKNET, 1, "it")


def test_the_round_of_a_time_is_the_first_that_is_not_before_it() -> None:
    for seconds, number in ((0, 1), (1, 2), (3, 2), (4, 3), (-50, 1)):
        when = datetime.fromtimestamp(QUICKNET.genesis + seconds, UTC)
        assert QUICKNET.first_at(when) == number
        assert seconds < 0 or QUICKNET.time_of(number) >= when
