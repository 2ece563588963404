"""The generator of draws against a second implementation; season files and what they refuse."""

from __future__ import annotations

import hashlib
import hmac
import os
import stat
from datetime import date
from fractions import Fraction
from pathlib import Path
from typing import Any

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


def new(**changes: Any) -> tuple[seasons.Season, bytes]:
    values: dict[str, Any] = {
        "id": "2027-spring",
        "protocol": 2,
        "draws": 20,
        "opens": date(2027, 3, 1),
        "closes": date(2027, 6, 30),
        "runs_per_week": 3,
    }
    return seasons.new_season(**(values | changes))


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
        lambda seed: seasons.derived_key(seed, "x"),
        seasons.commitment,
    ):
        with pytest.raises(InputError, match=f"32 bytes; this one has {length}"):
            use(bytes(length))


def test_a_key_is_none_of_the_numbers() -> None:
    key = seasons.derived_key(SEED, "noise")
    assert len(key) == 32
    assert key != hmac.digest(SEED, b"ventbench uniforms 1\nnoise" + bytes(8), "sha256")
    assert key != seasons.derived_key(SEED, "noise2")


def test_a_season_is_read_as_it_was_written(tmp_path: Path) -> None:
    season, seed = new()
    path = tmp_path / "2027-spring.toml"
    seasons.write_season(path, season)
    assert seasons.read_season(path) == season
    assert season.revealed is None
    assert seed.hex() not in path.read_text()
    seasons.write_season(path, seasons.reveal(season, seed))
    assert seasons.read_season(path).revealed == seed


def test_another_seed_is_not_revealed(tmp_path: Path) -> None:
    season, _ = new()
    with pytest.raises(InputError, match="not the one of its commitment") as raised:
        seasons.reveal(season, SEED)
    assert SEED.hex() not in str(raised.value)
    path = tmp_path / "2027-spring.toml"
    seasons.write_season(path, season)
    path.write_text(path.read_text() + f'seed = "{SEED.hex()}"\n')
    with pytest.raises(InputError, match="not the one of its commitment"):
        seasons.read_season(path)


@pytest.mark.parametrize(
    ("old", "new_text", "message"),
    [
        ('id = "2027-spring"', 'id = "../x"', "id"),
        ('id = "2027-spring"', 'id = "other"', "not the name of the file"),
        ('id = "2027-spring"', 'id = "development"', "the name of the published draws"),
        ("draws = 20", "draws = 0", "draws"),
        ("draws = 20", "draws = 20.5", "draws"),
        ("draws = 20", f"draws = 1{'0' * 5000}", "2027-spring.toml"),
        ("closes = 2027-06-30", "closes = 2026-06-30", "is before"),
        ("closes = 2027-06-30", "closes = 2027-02-30", "2027-spring.toml"),
        ("runs_per_week = 3", "", "runs_per_week"),
        ("runs_per_week = 3", "runs_per_week = 3\nmore = 1", "more"),
        ("runs_per_week = 3", "runs_per_week = [[[", "2027-spring.toml"),
        ("commitment = ", "commitment = 'x' # ", "commitment"),
    ],
)
def test_wrong_season_files_are_named(
    tmp_path: Path, old: str, new_text: str, message: str
) -> None:
    path = tmp_path / "2027-spring.toml"
    seasons.write_season(path, new()[0])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new_text))
    with pytest.raises(InputError, match=message):
        seasons.read_season(path)


def test_what_is_no_file_is_no_season(tmp_path: Path) -> None:
    real, link = tmp_path / "a.toml", tmp_path / "2027-spring.toml"
    seasons.write_season(real, new()[0])
    link.symlink_to(real)
    for path in (link, tmp_path / "missing.toml", tmp_path):
        with pytest.raises(InputError, match="not a plain file"):
            seasons.read_season(path)
    real.write_bytes(b"#" * (seasons.MAX_BYTES + 1))
    with pytest.raises(InputError, match="larger than"):
        seasons.read_season(real)


def test_seed_files_are_private(tmp_path: Path) -> None:
    path = tmp_path / "seed"
    before = os.umask(0)
    try:
        seasons.write_seed(path, SEED)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert seasons.read_seed(path) == SEED
    with pytest.raises(InputError, match="never overwritten"):
        seasons.write_seed(path, SEED)
    path.chmod(0o644)
    with pytest.raises(InputError, match="chmod 600"):
        seasons.read_seed(path)


@pytest.mark.parametrize("text", ["", "00" * 31, "00" * 33, "zz" * 32, "secret" * 20])
def test_no_message_holds_a_wrong_seed(text: str) -> None:
    with pytest.raises(InputError, match="64 hexadecimal digits") as raised:
        seasons.parse_seed(text, "the variable")
    assert not text or text not in str(raised.value)
