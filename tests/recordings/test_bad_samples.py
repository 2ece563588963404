"""Samples that are no readings are found, listed and left out; sound signals are left alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ventbench.base.errors import InputError
from ventbench.mechanics import identify
from ventbench.recordings import check, load, make_breaths, require_roles, write
from ventbench.recordings.bad_samples import blanked, clean, find_bad_samples, repeated_rows
from ventbench.recordings.breaths import join

RATE, PERIOD = 50.0, 3.0


def signals(seed: int = 0, cycles: int = 12) -> dict[str, np.ndarray]:
    """Pressure, cmH2O, and flow, mL/s, of R20C50 under pressure control, with noise."""
    phase = np.tile(np.arange(0.0, PERIOD, 1.0 / RATE), cycles)
    inside = phase < 1.0
    rising = 750.0 * np.exp(-phase)
    flow = np.where(inside, rising, -750.0 * (1.0 - np.exp(-1.0)) * np.exp(-(phase - 1.0)))
    noise = np.random.default_rng(seed).normal(size=(2, len(phase)))
    return {
        "pressure": np.round(np.where(inside, 20.0, 5.0) + 0.1 * noise[0], 3),
        "flow": np.round(flow + 4.0 * noise[1], 2),
    }


def recording(columns: dict[str, np.ndarray]):
    shape = (12, round(PERIOD * RATE))
    time = np.broadcast_to(np.arange(shape[1]) / RATE, shape)
    u_in = np.where(time < 1.0, 30.0, 0.0)
    labels = (np.full(12, 20.0), np.full(12, 50.0))
    split = {name: values.reshape(shape) for name, values in columns.items()}
    pressure = split.pop("pressure")
    return make_breaths(np.arange(12), *labels, time, u_in, u_in == 0.0, pressure, **split)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("digits", [0, 1, 3, 12])
def test_sound_signals_are_left_alone(seed, digits):
    columns = {
        name: np.asarray(np.round(values, digits), float) for name, values in signals(seed).items()
    }
    assert find_bad_samples(columns) == ()


@pytest.mark.parametrize("name", ["pressure", "flow"])
@pytest.mark.parametrize("mark", [-9999.0, -1650.0, -1e30, 32767.0])
def test_marks_are_found_by_themselves(name, mark):
    columns = signals()
    at = np.random.default_rng(1).choice(np.arange(3, 1797), 12, replace=False)
    columns[name] = columns[name].copy()
    columns[name][at] = mark
    (found,) = find_bad_samples(columns)
    assert (found.column, found.kind, found.of) == (name, "mark", 1800)
    np.testing.assert_array_equal(found.rows, np.sort(at))
    assert f"12 of 1800 readings of {name} (0.67 %) are {mark:g}, which stands" in found.what()


@settings(max_examples=40, deadline=None)
@given(
    at=st.sets(st.integers(5, 1790), min_size=1, max_size=20),
    size=st.floats(1.0, 50.0),
    name=st.sampled_from(["pressure", "flow"]),
)
def test_isolated_values_far_off_are_found_and_nothing_else(at, size, name):
    columns = signals()
    rows = np.array([row for row in sorted(at) if not {row - 1, row - 2, row - 3} & at])
    rows = rows[np.isin(rows % 150, [*range(4, 46), *range(54, 146)])]  # not where all jumps
    assume(len(rows))
    columns[name] = columns[name].copy()
    columns[name][rows] += size * np.ptp(columns[name]) * np.where(rows % 2, 1.0, -1.0)
    bad = find_bad_samples(columns)
    np.testing.assert_array_equal(np.sort(np.concatenate([x.rows for x in bad])), rows)
    assert find_bad_samples(blanked(columns, bad)) == ()


def test_held_values_are_found_but_not_a_level_of_a_simulation():
    columns = signals()
    for start in (100, 700, 1300):
        for values in columns.values():
            values[start + 1 : start + 6] = values[start]
    bad = find_bad_samples(columns)
    assert {(x.column, x.kind, len(x.rows)) for x in bad} == {
        ("pressure", "held", 15),
        ("flow", "held", 15),
    }
    phase = np.tile(np.arange(0.0, PERIOD, 1.0 / RATE), 12)
    level = np.where(phase < 1.0, 5.0 + 15.0 * np.minimum(phase, 0.7), 5.0)
    assert find_bad_samples({"pressure": level}) == ()


def test_zeros_while_packets_are_lost_are_found_however_few_follow_one_another():
    columns = signals()
    rows = np.concatenate([np.arange(at, at + k) for k, at in enumerate((310, 618, 1060, 1215), 2)])
    columns["flow"][rows] = 0.0
    bad = find_bad_samples(columns)
    assert {x.column for x in bad} == {"flow"}
    np.testing.assert_array_equal(np.sort(np.concatenate([x.rows for x in bad])), rows)


def test_zeros_that_mean_missing_are_found_on_edges_and_in_small_flows():
    columns = signals()
    rng = np.random.default_rng(2)
    rows = np.sort(rng.choice(np.arange(3, 1797), 40, replace=False))
    edges = np.array([300, 500, 750])  # where inspiration begins, or ends
    rows = np.union1d(rows, edges)
    small = np.abs(columns["flow"]) < 40.0  # what is not far from zero may be zero
    rows = rows[~small[rows - 1] & ~small[rows + 1]]
    columns["flow"][rows] = 0.0
    (found,) = find_bad_samples(columns)
    assert found.kind == "mark"
    np.testing.assert_array_equal(found.rows, rows)
    assert set(edges) <= set(rows.tolist())


def test_zeros_at_which_a_flow_turns_are_readings():
    columns = signals()
    columns["flow"][np.arange(50, 1790, 150)] = 0.0  # between inspiration and expiration
    assert find_bad_samples(columns) == ()


@pytest.mark.parametrize("row", [299, 300, 449, 450, 520])  # beside steps of the flow, or far off
def test_a_spike_on_an_edge_of_a_flow_is_found(row):
    columns = signals()
    assert find_bad_samples(columns) == ()
    neighbours = columns["flow"][[row - 1, row + 1]]
    columns["flow"][row] = neighbours.max() + 600.0
    (found,) = find_bad_samples(columns)
    assert (found.kind, found.rows.tolist()) == ("isolated", [row])


def test_a_dip_before_a_rise_is_a_reading():
    """It goes there and back at once, but goes on: a trigger, or a breath that begins anew."""
    columns = signals()
    starts, rng = np.arange(150, 1800, 150), np.random.default_rng(0)
    for k, value in enumerate((2.5, 7.0, 11.0, 14.0, 17.0)):
        columns["pressure"][starts + k] = value + rng.normal(0.0, 0.1, len(starts))
    assert find_bad_samples(columns) == ()


def test_a_spike_that_others_hide_is_found():
    columns = signals()
    rows = np.array([320, 322, 324])
    columns["pressure"][rows] = [80.0, 50.0, 60.0]
    (found,) = find_bad_samples(columns)
    assert found.kind == "isolated"
    np.testing.assert_array_equal(found.rows, rows)


def test_no_flow_at_rest_is_a_reading_and_a_dead_sensor_is_not():
    """A flow without noise, which steps with the valve, is exactly zero in a lung at rest."""
    rng = np.random.default_rng(0)
    phase = np.tile(np.arange(0.0, 4.0, 0.04), 4)
    flow = np.where(phase < 1.0, rng.uniform(50.0, 500.0, phase.size), 0.0)
    flow += np.where((phase > 1.0) & (phase < 2.0), -300.0 * np.exp(-3.0 * phase), 0.0)
    volume = np.where(phase < 1.0, 0.3 * phase, 0.3 * np.exp(-8.0 * np.maximum(phase - 1.0, 0.0)))
    pressure = 5.0 + 50.0 * volume + rng.normal(0.0, 0.05, phase.size)
    assert find_bad_samples({"pressure": pressure, "flow": flow}) == ()
    flow[(phase > 0.2) & (phase < 0.8)] = 0.0
    bad = find_bad_samples({"pressure": pressure, "flow": flow})
    assert {x.column for x in bad} == {"flow"}


def test_a_sensor_slower_than_the_rows_is_named():
    columns = signals()
    columns["pressure"] = np.repeat(columns["pressure"][::4], 4)
    (found,) = find_bad_samples(columns)
    assert found.kind == "slow"
    assert "pressure changes in one of 4 rows only" in found.what()


def test_clean_is_idempotent_and_leaves_sound_breaths_as_they_are():
    sound = recording(signals())
    assert clean(sound) is sound
    columns = signals()
    columns["pressure"][[40, 400, 900]] = 99.99
    cleaned = clean(recording(columns))
    assert int(np.isnan(cleaned.pressure).sum()) == 3
    assert "3 of 1800 readings of pressure" in cleaned.notes[0]
    assert clean(cleaned) is cleaned


def test_a_recording_with_too_many_is_unusable(tmp_path):
    columns = signals()
    columns["pressure"][np.random.default_rng(0).permutation(1800)[:400]] = -50.0
    write(
        recording({**columns, "pressure": np.clip(columns["pressure"], -20.0, None)}),
        tmp_path / "a.csv",
    )
    report = check(tmp_path / "a.csv", missing=[-20.0])
    assert not report.ok
    assert "the recording is unusable" in report.problems[0].advice


def test_every_door_leaves_the_same_samples_out(tmp_path):
    columns = signals()
    at = np.random.default_rng(3).choice(np.arange(3, 1797), 10, replace=False)
    columns["flow"][at] = -99.0 / 0.06
    spoiled = recording(columns)
    write(spoiled, tmp_path / "a.csv")
    read = load(tmp_path / "a.csv")
    assert read.flow is not None
    np.testing.assert_array_equal(np.isnan(read.flow).ravel().nonzero()[0], np.sort(at))
    assert "10 of 1800 readings of flow (0.56 %) are -1650" in read.notes[0]
    report = check(tmp_path / "a.csv")
    assert (report.ok, len(report.suspicious)) == (True, 1)
    for breaths in (read, spoiled):
        (lung,) = identify(breaths)
        assert lung.terms == ()
        for truth, found in ((20.0, lung.R), (50.0, lung.C)):
            assert found.ci95[0] < truth < found.ci95[1]
    assert dataclasses.replace(read, notes=()).pressure.shape == spoiled.pressure.shape


def test_a_notable_share_is_said_first_and_a_large_one_is_refused():
    columns = signals()
    at = np.random.default_rng(3).permutation(1800)
    columns["flow"][at[:40]] = -1650.0
    breaths = clean(recording(columns))
    assert breaths.left_out == {"flow": pytest.approx(40 / 1800)}
    said = "2.2 % of the readings of flow are none and are left out"
    assert identify(breaths)[0].notes[0] == f"{said}."
    assert join([breaths, recording(signals(1))]).left_out["flow"] == pytest.approx(20 / 1800)
    columns["flow"][at[:400]] = -1650.0
    spoiled = clean(recording(columns), [-1650.0])
    for door in (identify, require_roles):
        with pytest.raises(InputError, match=r"22 % of the readings of flow .* is unusable"):
            door(spoiled)


@pytest.mark.parametrize("seed", range(4))
def test_rows_that_come_twice_are_told_from_rows_that_are_held(seed):
    """Without a clock the signal goes on by one step behind the first, by two behind the others."""
    columns = signals(seed)
    at = np.sort(np.random.default_rng(seed).choice(np.arange(5, 1790), 40, replace=False))
    at = np.union1d(at, [301, 451])  # on edges, where no line fits
    order = np.sort(np.concatenate([np.arange(1800), at]))
    twice = {name: values[order] for name, values in columns.items()}
    assert repeated_rows(twice).sum() == len(at)
    held = {name: values.copy() for name, values in columns.items()}
    for values in held.values():
        values[at] = values[at - 1]
    assert not repeated_rows(held).any()
