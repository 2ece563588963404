"""Breaths are known again by lung, commands and pressures, in whatever digits they come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ventbench.recordings import join, load, make_breaths, write
from ventbench.recordings.identity import (
    CELL,
    SAMPLES,
    TOLERANCE,
    fingerprints,
    match,
    repetitions,
)

LUNGS = ["R5C10", "R20C50", "R5C10", "R20C20"]
FILES = (
    "pvp_quicklung.csv",
    "pvp_quicklung_reconstructed.csv",
    "pvp_quicklung_reconstructed_2.csv",
)


def in_digits(breaths, function):
    return replace(breaths, u_in=function(breaths.u_in), pressure=function(breaths.pressure))


def single(values):
    return values.astype(np.float32).astype(float)


def shortened(breaths, rows):
    """A copy without its last rows."""
    names = ("time", "dt", "u_in", "u_out", "pressure", "valid")
    return replace(breaths, **{name: getattr(breaths, name)[:, :-rows] for name in names})


EXPORTS = {
    "two decimals": lambda b: in_digits(b, lambda x: np.round(x, 2)),
    "three decimals": lambda b: in_digits(b, lambda x: np.round(x, 3)),
    "three, then two": lambda b: in_digits(b, lambda x: np.round(np.round(x, 3), 2)),
    "single precision": lambda b: in_digits(b, single),
    "two decimals of single precision": lambda b: in_digits(b, lambda x: np.round(single(x), 2)),
    "cut to bins of 0.01": lambda b: in_digits(b, lambda x: np.floor(100 * x) / 100 + 0.005),
    "without the last rows": lambda b: shortened(b, 25),
    "another clock and other ids": lambda b: replace(
        b, breath_id=b.breath_id + 7, time=1.1 * b.time, dt=1.1 * b.dt
    ),
}


def made(lungs, u_in, random):
    """Breaths under some commands, which inspire all the time, with pressures of no meaning."""
    n, samples = u_in.shape
    return make_breaths(
        breath_id=np.arange(1, n + 1),
        R=np.array([float(name[1:].split("C")[0]) for name in lungs]),
        C=np.array([float(name.split("C")[1]) for name in lungs]),
        time=np.tile(0.03 * np.arange(samples), (n, 1)),
        u_in=u_in,
        u_out=np.zeros((n, samples), int),
        pressure=random.uniform(5.0, 35.0, (n, samples)),
    )


@pytest.fixture
def breaths():
    random = np.random.default_rng(0)
    return made(LUNGS, random.uniform(0.0, 100.0, (len(LUNGS), 30)), random)


@pytest.fixture(scope="module")
def recorded(public_recordings):
    return join([load(public_recordings / name) for name in FILES])


@pytest.mark.parametrize("export", EXPORTS)
def test_every_recorded_breath_is_known_in_every_export(recorded, export):
    found = match(EXPORTS[export](recorded), fingerprints(recorded))
    np.testing.assert_array_equal(found.known, np.arange(len(recorded)))
    assert found.certain.all()


def test_no_recorded_breath_is_taken_for_another(recorded):
    """Of 50,739 pairs on the same lung none: fewer than 6 in 100,000, with 95 % confidence."""
    copy, repeat = repetitions(recorded)
    np.testing.assert_array_equal(copy, np.arange(len(recorded)))
    np.testing.assert_array_equal(repeat, copy)


def test_through_a_file_of_two_decimals(breaths, tmp_path):
    write(EXPORTS["two decimals"](breaths), tmp_path / "copy.csv")
    found = match(load(tmp_path / "copy.csv"), fingerprints(breaths))
    assert found.known.tolist() == [0, 1, 2, 3]
    assert found.certain.all()


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.04, 1.0, 30.0]))
def test_none_within_the_tolerance_is_missed_and_none_beyond_is_matched(seed, scale):
    """Anything that a copy may be off, in steps and levels that lie on edges of cells as well."""
    random = np.random.default_rng(seed)
    shape = (5, SAMPLES + 4)
    u_in = np.clip(random.normal(random.uniform(0.0, 100.0), scale, shape), 0.0, 100.0)
    breaths = made(
        ["R5C10"] * 5, np.round(u_in / CELL * 6) * CELL / 6 if seed % 2 else u_in, random
    )
    off = random.choice([-1.0, 1.0, 0.0, random.uniform(-1.0, 1.0)], (2, *shape)) * TOLERANCE
    copy = replace(breaths, u_in=breaths.u_in + off[0], pressure=breaths.pressure + off[1])
    found = match(copy, fingerprints(breaths))
    np.testing.assert_array_equal(found.known, np.arange(5))
    assert found.certain.all()
    other = breaths.u_in.copy()
    other[:, random.integers(SAMPLES)] += random.choice([-1.0, 1.0]) * (CELL + 2.01 * TOLERANCE)
    alone = breaths.select([0])
    assert match(replace(alone, u_in=other[:1]), fingerprints(alone)).known.tolist() == [-1]


def test_lung_commands_and_pressures_each_make_another_breath(breaths):
    known = fingerprints(breaths)
    u_in, pressure = breaths.u_in.copy(), breaths.pressure.copy()
    u_in[1, 4] += 0.06
    pressure[3, 9] -= 0.06
    changed = replace(breaths, u_in=u_in, pressure=pressure)
    assert match(changed, known).known.tolist() == [0, -1, 2, -1]
    lungs = replace(breaths, C=np.array([20.0, 50.0, 10.0, 20.0]))
    assert match(lungs, known).known.tolist() == [-1, 1, 2, 3]


def test_blank_pressures_make_a_copy_probable_only(breaths):
    blank = replace(breaths, pressure=np.full_like(breaths.pressure, np.nan))
    for asked, kept in ((blank, breaths), (breaths, blank)):
        found = match(asked, fingerprints(kept))
        assert found.known.tolist() == [0, 1, 2, 3]
        assert not found.certain.any()
    assert match(blank, fingerprints(blank)).certain.all()
    partly = breaths.pressure.copy()
    partly[2, 5] = np.nan
    found = match(replace(breaths, pressure=partly), fingerprints(breaths))
    assert found.certain.tolist() == [True, True, False, True]


def test_copies_and_repeats_are_told_apart(breaths):
    repeat = replace(breaths.select([1, 2]), pressure=breaths.pressure[[1, 2]] + 0.3)
    blank = replace(breaths.select([3]), pressure=np.full_like(breaths.pressure[[3]], np.nan))
    whole = join([breaths, EXPORTS["two decimals"](breaths.select([1])), repeat, blank])
    copy, same_commands = repetitions(whole)
    assert copy.tolist() == [0, 1, 2, 3, 1, 5, 6, 3]
    assert same_commands.tolist() == [0, 1, 2, 3, 1, 1, 2, 3]


def test_fingerprints_hold_no_value(breaths):
    prints = fingerprints(breaths)
    for keys in (prints.commands, prints.pressures):
        assert keys.dtype == np.uint64
        assert len(np.unique(keys)) == keys.size == 3 * len(LUNGS)
    with pytest.raises(AttributeError):
        _ = prints.u_in  # type: ignore[attr-defined]
