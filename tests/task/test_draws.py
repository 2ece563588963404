"""Draws on rigs: what they are, that they are the same everywhere, and what a lung gets of them."""

import hashlib
import hmac
from fractions import Fraction

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ventbench.base.errors import InputError
from ventbench.plants import frozen
from ventbench.task import draws, protocol

SEED = bytes(range(32))

RIGS = ((2, 0, 1), (5,), (7, 8))


@pytest.fixture(scope="module")
def drawn():
    return draws.build(RIGS, 5)


def test_shapes_and_ranges(drawn):
    cells = drawn.cells
    for name, (low, high) in draws.RANGES.items():
        assert low < high, name
    assert cells.pip.shape == (3, draws.COUNT, 6)
    assert cells.noise.shape == (
        3,
        draws.COUNT,
        6,
        protocol.BREATHS,
        protocol.INSPIRATION_STEPS,
    )
    assert all(leaf.dtype == np.float64 for leaf in jax.tree.leaves(cells))
    for value, name in ((cells.r_scale, "r_scale"), (cells.c_scale, "c_scale")):
        low, high = draws.RANGES[name]
        assert np.all((low <= value) & (value <= high))
        assert np.ptp(value) > 0.9 * (high - low)
    assert np.all(np.abs(cells.pip - np.array(protocol.PIPS)) <= 1.0)


def test_noise_differs_from_lung_to_lung(drawn):
    noise = drawn.cells.noise.reshape(3, -1)
    assert np.all(np.abs(np.corrcoef(noise)[np.triu_indices(3, 1)]) < 0.03)
    assert 0.21 < noise.std() < 0.24


def test_rigs_and_members_are_drawn_equally_often(drawn):
    for own, rig, member in zip(RIGS, drawn.rig, drawn.member, strict=True):
        counts = [np.sum(rig == session) for session in own]
        assert sum(counts) == draws.COUNT
        assert max(counts) - min(counts) <= 1
        assert np.bincount(member, minlength=5).tolist() == [4] * 5


def test_a_seed_gives_the_same_draws_and_another_seed_others(drawn):
    again = draws.build(RIGS, 5, seed=draws.DEVELOPMENT_SEED)
    other = draws.build(RIGS, 5, seed=bytes(32), name="2027-spring")
    np.testing.assert_array_equal(again.cells.noise, drawn.cells.noise)
    np.testing.assert_array_equal(again.rig, drawn.rig)
    assert not np.array_equal(other.cells.pip, drawn.cells.pip)
    assert drawn.about()["season"] == "development"
    assert other.about() == {
        "version": 2,
        "sha256": draws.commitment(bytes(32)),
        "count": 20,
        "season": "2027-spring",
    }


def test_published_numbers_stay(drawn):
    # The first shift of PIP by the definition in ventbench.task.draws, by hand.
    import hashlib
    import hmac

    block = hmac.new(
        hashlib.sha256(b"ventbench development draws").digest(),
        b"ventbench uniforms 1\ndraws 2, pip_shift" + bytes(8),
        "sha256",
    ).digest()
    uniform = ((int.from_bytes(block[:8], "big") >> 12) + 0.5) / 2**52
    assert drawn.cells.pip[0, 0, 0] == pytest.approx(
        10.0 + round(2.0 * uniform - 1.0, 4), abs=1e-12
    )


def test_first_draws_are_those_of_all(drawn):
    few = drawn.first(3)
    np.testing.assert_array_equal(few.cells.noise, drawn.cells.noise[:, :3])
    assert few.count == 3
    with pytest.raises(InputError, match=r"20 development draws; 21 is outside 1\.\.20"):
        drawn.first(21)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n": 0}, "there must be at least one"),
        ({"pips": (12.0,)}, "no draws for PIP 12 cmH2O"),
        ({"rigs": ((1,), ())}, "a lung has no rig"),
        ({"seed": b"short"}, "32 bytes"),
    ],
)
def test_wrong_requests_are_named(change, message):
    with pytest.raises(InputError, match=message):
        draws.build(**({"rigs": RIGS, "members": 2} | change))


def test_plants_of_cells_are_those_of_rig_and_member():
    official = frozen.load()
    drawn = draws.build(official.rigs, 5, n=4)
    reference = [own[0] for own in official.rigs]
    cells, rig, member = draws.with_nominal(drawn, reference, protocol.PIPS)
    plants = draws.plants_of(official.sessions_plants, rig, member)
    assert cells.pip.shape == (6, 5, 6)
    np.testing.assert_array_equal(cells.dt[:, 0], protocol.DT)
    assert plants.R.shape == (6, 5, 1)
    assert plants.slopes.shape[:3] == (6, 5, 1)
    np.testing.assert_array_equal(plants.R[:, 0, 0], official.plants.R)
    k = 2
    expected = official.sessions_plants.E[drawn.member[3, k], drawn.rig[3, k]]
    assert plants.E[3, 1 + k, 0] == expected


def test_noise_is_white_and_as_large_as_the_sensors():
    noise = draws.build(RIGS, 1).cells.noise.reshape(3 * 20 * 6, -1)
    assert np.all((noise.std(axis=1) > 0.15) & (noise.std(axis=1) < 0.31))
    assert 0.21 < noise.std() < 0.24
    assert abs(noise.mean()) < 0.01
    assert abs(np.mean(noise[:, 1:] * noise[:, :-1])) < 0.002
    # Gaussian: 4.55 % beyond two standard deviations.
    scaled = noise / noise.std(axis=1, keepdims=True)
    assert np.mean(np.abs(scaled) > 2) == pytest.approx(0.0455, abs=0.01)


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
    assert draws.uniforms(SEED, "noise", 4).tolist() == expected


@given(st.binary(min_size=32, max_size=32), st.text(max_size=8), st.integers(0, 23))
def test_numbers_are_those_of_another_implementation(seed: bytes, label: str, count: int) -> None:
    numbers = draws.uniforms(seed, label, count)
    assert [Fraction(number) for number in numbers.tolist()] == exact(seed, label, count)


def test_extremes_stay_between_0_and_1(monkeypatch: pytest.MonkeyPatch) -> None:
    for byte, expected in ((b"\x00", 2.0**-53), (b"\xff", 1.0 - 2.0**-53)):
        monkeypatch.setattr(hmac, "digest", lambda *_, byte=byte: 32 * byte)
        assert draws.uniforms(SEED, "x", 4).tolist() == 4 * [expected]


def test_shapes_and_labels() -> None:
    flat = draws.uniforms(SEED, "a", 30)
    assert np.array_equal(draws.uniforms(SEED, "a", (2, 3, 5)), flat.reshape(2, 3, 5))
    assert np.array_equal(draws.uniforms(SEED, "a", 7), flat[:7])
    assert draws.uniforms(SEED, "a", ()).shape == ()
    assert draws.uniforms(SEED, "a", 0).shape == (0,)
    assert not np.intersect1d(flat, draws.uniforms(SEED, "b", 30)).size
    assert not np.intersect1d(flat, draws.uniforms(SEED[::-1], "a", 30)).size


def test_numbers_are_uniform_and_independent() -> None:
    numbers = draws.uniforms(draws.DEVELOPMENT_SEED, "statistics", 20_000)
    counts, _ = np.histogram(numbers, bins=20, range=(0.0, 1.0))
    # Chi-squared with 19 degrees of freedom: 45 is exceeded once in a thousand seeds.
    assert np.sum((counts - 1000.0) ** 2) / 1000.0 < 45.0
    assert abs(np.corrcoef(numbers[:-1], numbers[1:])[0, 1]) < 4.0 / np.sqrt(20_000)
