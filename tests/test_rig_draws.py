"""Draws on rigs: what they are, that they are the same everywhere, and what a lung gets of them."""

import jax
import numpy as np
import pytest

from ventbench import protocol, rig_draws, seasons
from ventbench.errors import InputError
from ventbench.plants import frozen

RIGS = ((2, 0, 1), (5,), (7, 8))


@pytest.fixture(scope="module")
def drawn():
    return rig_draws.build(RIGS, 5)


def test_shapes_and_ranges(drawn):
    cells = drawn.cells
    for name, (low, high) in rig_draws.RANGES.items():
        assert low < high, name
    assert cells.pip.shape == (3, rig_draws.COUNT, 6)
    assert cells.noise.shape == (
        3,
        rig_draws.COUNT,
        6,
        protocol.BREATHS,
        protocol.INSPIRATION_STEPS,
    )
    assert all(leaf.dtype == np.float64 for leaf in jax.tree.leaves(cells))
    for value, name in ((cells.r_scale, "r_scale"), (cells.c_scale, "c_scale")):
        low, high = rig_draws.RANGES[name]
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
        assert sum(counts) == rig_draws.COUNT
        assert max(counts) - min(counts) <= 1
        assert np.bincount(member, minlength=5).tolist() == [4] * 5


def test_a_seed_gives_the_same_draws_and_another_seed_others(drawn):
    again = rig_draws.build(RIGS, 5, seed=seasons.DEVELOPMENT_SEED)
    other = rig_draws.build(RIGS, 5, seed=bytes(32), season="2027-spring")
    np.testing.assert_array_equal(again.cells.noise, drawn.cells.noise)
    np.testing.assert_array_equal(again.rig, drawn.rig)
    assert not np.array_equal(other.cells.pip, drawn.cells.pip)
    assert drawn.about()["season"] == "development"
    assert other.about() == {
        "version": 2,
        "sha256": seasons.commitment(bytes(32)),
        "count": 20,
        "season": "2027-spring",
    }


def test_published_numbers_stay(drawn):
    # The first shift of PIP by the definition in ventbench.seasons, by hand.
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
    with pytest.raises(InputError, match=r"has 20 draws; 21 is outside 1\.\.20"):
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
        rig_draws.build(**({"rigs": RIGS, "members": 2} | change))


def test_plants_of_cells_are_those_of_rig_and_member():
    official = frozen.load()
    drawn = rig_draws.build(official.rigs, 5, n=4)
    reference = [own[0] for own in official.rigs]
    cells, rig, member = rig_draws.with_nominal(drawn, reference, protocol.PIPS)
    plants = rig_draws.plants_of(official.sessions_plants, rig, member)
    assert cells.pip.shape == (6, 5, 6)
    np.testing.assert_array_equal(cells.dt[:, 0], protocol.DT)
    assert plants.R.shape == (6, 5, 1)
    assert plants.slopes.shape[:3] == (6, 5, 1)
    np.testing.assert_array_equal(plants.R[:, 0, 0], official.plants.R)
    k = 2
    expected = official.sessions_plants.E[drawn.member[3, k], drawn.rig[3, k]]
    assert plants.E[3, 1 + k, 0] == expected
