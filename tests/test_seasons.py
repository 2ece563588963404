"""The generator of draws against a second implementation."""

from __future__ import annotations

import hashlib
import hmac
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ventbench import seasons
from ventbench.errors import InputError

SEED = bytes(range(32))


def exact(seed: bytes, label: str, count: int) -> list[Fraction]:
    """The stream once more, number by number and without floating point."""
    numbers: list[Fraction] = []
    block = 0
    while len(numbers) < count:
        mac = hmac.new(seed, digestmod=hashlib.sha256)
        mac.update(b"ventbench uniforms 1\n")
        mac.update(label.encode("utf-8"))
        mac.update(bytes([(block >> shift) & 255 for shift in range(56, -1, -8)]))
        digest = mac.digest()
        for first in range(0, 32, 8):
            upper = int(digest[first : first + 8].hex(), 16) >> 12
            numbers.append(Fraction(2 * upper + 1, 2**53))
        block += 1
    return numbers[:count]


def test_numbers_are_those_of_openssl() -> None:
    # printf 'ventbench uniforms 1\nnoise\0\0\0\0\0\0\0\0' |
    #   openssl dgst -sha256 -mac HMAC -macopt hexkey:000102...1f
    digest = "8ff88f2dee034a714d2738560e332b85696d921ae9e19b3b29767d937dde5b85"
    words = [int(digest[first : first + 16], 16) for first in range(0, 64, 16)]
    expected = [((word >> 12) + 0.5) / 2**52 for word in words]
    assert seasons.uniforms(SEED, "noise", 4).tolist() == expected


@given(st.binary(min_size=32, max_size=32), st.text(max_size=8), st.integers(0, 23))
def test_numbers_are_those_of_another_implementation(seed: bytes, label: str, count: int) -> None:
    numbers = seasons.uniforms(seed, label, count)
    assert [Fraction(number) for number in numbers.tolist()] == exact(seed, label, count)


def test_extremes_stay_between_0_and_1(monkeypatch: pytest.MonkeyPatch) -> None:
    for byte, expected in ((b"\x00", 2.0**-53), (b"\xff", 1.0 - 2.0**-53)):
        monkeypatch.setattr(hmac, "digest", lambda *_, byte=byte: 32 * byte)
        assert seasons.uniforms(SEED, "x", 4).tolist() == 4 * [expected]


def test_shapes_and_labels() -> None:
    flat = seasons.uniforms(SEED, "a", 30)
    assert np.array_equal(seasons.uniforms(SEED, "a", (2, 3, 5)), flat.reshape(2, 3, 5))
    assert np.array_equal(seasons.uniforms(SEED, "a", 7), flat[:7])
    assert seasons.uniforms(SEED, "a", ()).shape == ()
    assert seasons.uniforms(SEED, "a", 0).shape == (0,)
    assert not np.intersect1d(flat, seasons.uniforms(SEED, "b", 30)).size
    assert not np.intersect1d(flat, seasons.uniforms(SEED[::-1], "a", 30)).size


def test_numbers_are_uniform_and_independent() -> None:
    numbers = seasons.uniforms(seasons.DEVELOPMENT_SEED, "statistics", 20_000)
    counts, _ = np.histogram(numbers, bins=20, range=(0.0, 1.0))
    # Chi-squared with 19 degrees of freedom: 45 is exceeded once in a thousand seeds.
    assert np.sum((counts - 1000.0) ** 2) / 1000.0 < 45.0
    assert abs(np.corrcoef(numbers[:-1], numbers[1:])[0, 1]) < 4.0 / np.sqrt(20_000)


def test_commitment_is_a_hash_that_sha256sum_gives() -> None:
    # (printf 'ventbench season 1\n'; head -c 32 /dev/zero) | sha256sum
    assert (
        seasons.commitment(bytes(32))
        == "c0b1d368bf623b9075d35a13c813fe6ed9f6c42f17c54f6f0e7a14f68135cf99"
    )
    assert seasons.commitment(SEED) != seasons.commitment(bytes(32))
    # printf 'ventbench development draws' | sha256sum
    assert (
        seasons.DEVELOPMENT_SEED.hex()
        == "b8065e5334aea83e7945850a842718fe96a2afdc9b1249d7594c04e3b2fd9638"
    )


@pytest.mark.parametrize("length", [0, 31, 33])
def test_a_seed_has_32_bytes(length: int) -> None:
    for use in (
        lambda seed: seasons.uniforms(seed, "x", 1),
        seasons.commitment,
    ):
        with pytest.raises(InputError, match=f"32 bytes; this one has {length}"):
            use(bytes(length))
