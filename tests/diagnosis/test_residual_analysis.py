"""Errors by hand; where they lie: in the right range, and by chance as rarely as promised."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis.corrected import (
    compare_open_loop,
    open_loop_error,
)
from ventbench.diagnosis.experiment import Judge
from ventbench.diagnosis.flow_drive import most_alike
from ventbench.diagnosis.residual_analysis import (
    axes,
    before,
    excess_over_noise,
    locate,
    of_breaths,
    p_values,
    profiles,
    quiet_samples,
    round_edges,
    since_edge,
    statistic,
)
from ventbench.diagnosis.settings import DEFAULT
from ventbench.recordings import join
from ventbench.recordings.breaths import Breaths

from . import made

SD = 0.2


def coloured(rng: np.random.Generator, shape: tuple[int, int], rho: float) -> np.ndarray:
    """AR(1) noise of standard deviation SD, each breath anew."""
    noise = SD * np.sqrt(1.0 - rho**2) * rng.standard_normal(shape)
    noise[:, 0] /= np.sqrt(1.0 - rho**2)
    for i in range(1, shape[1]):
        noise[:, i] += rho * noise[:, i - 1]
    return noise


def exact(seed: int, n: int = 60, samples: int = 80, lungs: int = 1):
    """Breaths that a simulator explains without any error, its pressure, flow and volume."""
    rng = np.random.default_rng(seed)
    dt = 0.032 + rng.uniform(-0.001, 0.001, (n, samples))
    time = np.concatenate([np.zeros((n, 1)), np.cumsum(dt[:, :-1], axis=1)], axis=1)
    u_out = (time >= 1.0).astype(np.int8)
    fall = rng.uniform(5.0, 60.0, (n, 1)) * np.exp(-2.0 * time)
    u_in = np.where(u_out == 0, fall + rng.uniform(0.0, 10.0, (n, 1)), 0.0)
    R = np.where(np.arange(n) < n // lungs, 20.0, 5.0)
    flow = 22.8 * before(u_in) * (before(u_out) == 0)
    volume = np.cumsum(flow * dt, axis=1) * (u_out == 0)
    pressure = 5.0 + volume / 50.0 + 0.02 * flow
    recorded = Breaths(
        np.arange(n),
        R,
        np.full(n, 50.0),
        time,
        dt,
        u_in,
        u_out,
        pressure.copy(),
        np.ones((n, samples), bool),
        np.zeros(n, bool),
    )
    return recorded, pressure, flow, volume


def with_error(seed: int, error, rho: float = 0.3, settings=DEFAULT.residuals, **more):
    """Places of breaths with an error, which is a function of them, on top of noise."""
    recorded, pressure, flow, volume = exact(seed, **more)
    noise = coloured(np.random.default_rng(1000 + seed), pressure.shape, rho)
    seen = dataclasses.replace(recorded, pressure=pressure + noise + error(recorded))
    return locate(seen, pressure, SD, flow, volume, settings=settings)


@pytest.mark.parametrize(("n", "lungs", "rho"), [(60, 1, 0.0), (60, 2, 0.7), (12, 1, 0.5)])
def test_chance_alone_gives_a_place_as_often_as_promised(n, lungs, rho):
    """Of 300 recordings without any mismatch, 2 to 9 % have a region (5 % are allowed)."""
    few = dataclasses.replace(DEFAULT.residuals, flips=200)  # a tenth of the usual time
    found = sum(
        bool(with_error(k, lambda b: 0.0, rho, settings=few, n=n, lungs=lungs)) for k in range(300)
    )
    assert 0.02 * 300 <= found <= 0.09 * 300


def test_a_bump_after_the_start_of_inspiration_is_found_there():
    for seed in range(5):
        places = with_error(seed, lambda b: -0.3 * (b.time < 0.2))
        (place,) = [p for p in places if p.axis == "time since inspiration"]
        assert (place.low, place.high) == (0.0, 0.2)
        assert place.mean_error == pytest.approx(-0.3, abs=0.05)
        assert place.p_value < 0.01
        assert place.share > 0.8
        assert places[0] == place, "it explains most"


def test_an_error_of_changing_sign_is_found_by_its_square():
    def effort(breaths: Breaths) -> np.ndarray:
        sign = np.where(np.arange(len(breaths)) % 2, 1.0, -1.0)[:, None]
        return 0.6 * sign * ((breaths.time > 0.4) & (breaths.time < 0.8))

    places = with_error(3, effort)
    (place,) = [p for p in places if p.axis == "time since inspiration"]
    assert (place.low, place.high) == (0.4, 0.8)
    assert abs(place.mean_error) < 0.05
    assert place.share > 0.8


def test_a_drift_is_found_over_the_breaths():
    places = with_error(4, lambda b: np.linspace(-0.6, 0.6, len(b))[:, None] * np.ones((1, 80)))
    early, late = sorted((p for p in places if p.axis == "breath number"), key=lambda p: p.low)
    assert (early.low, late.high) == (0, 59), "ids of the first and the last breath"
    assert early.mean_error < -0.2 < 0.2 < late.mean_error


def test_an_error_of_one_lung_is_found_on_it():
    places = with_error(5, lambda b: 0.5 * (b.R == 5.0)[:, None] * (b.u_out == 0), lungs=2)
    lungs = {p.axis: p for p in places if p.axis.startswith("lung")}
    assert list(lungs) == ["lung R5C50"]
    assert lungs["lung R5C50"].share > 0.9


def test_an_error_of_volume_is_found_along_it():
    recorded, pressure, flow, volume = exact(6)
    noise = coloured(np.random.default_rng(7), pressure.shape, 0.3)
    seen = dataclasses.replace(recorded, pressure=pressure + noise + 0.5 * (volume > 450.0))
    places = locate(seen, pressure, SD, flow, volume)
    place = max((p for p in places if p.axis == "volume"), key=lambda p: p.share)
    assert (place.low, place.unit) == (450.0, "mL")
    assert place.mean_error == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("times", [1.25, 9.0])
def test_noise_that_differs_from_place_to_place_is_no_place(times):
    """However large it is where gas flows: neighbouring readings share nothing of it."""
    recorded, pressure, flow, volume = exact(8, n=200)
    noise = SD * np.random.default_rng(8).standard_normal(pressure.shape)
    noise *= np.where(recorded.u_out == 0, np.sqrt(times), 1.0)
    seen = dataclasses.replace(recorded, pressure=pressure + noise)
    assert locate(seen, pressure, SD, flow, volume) == ()


def test_gaps_and_few_breaths():
    recorded, pressure, flow, volume = exact(10)
    holes = pressure - 0.4 * (recorded.time < 0.2)
    holes[::3, 40:] = np.nan
    valid = np.ones(holes.shape, bool)
    valid[5, 60:] = False
    seen = dataclasses.replace(recorded, pressure=holes, valid=valid)
    noisy = dataclasses.replace(
        seen, pressure=holes + coloured(np.random.default_rng(0), holes.shape, 0.0)
    )
    places = locate(noisy, pressure, SD, flow, volume)
    (place,) = [p for p in places if p.axis == "time since inspiration"]
    assert (place.low, place.high) == (0.0, 0.2)
    few = noisy.select(np.arange(4))
    told = locate(few, pressure[:4], SD, flow[:4], volume[:4])
    assert told == (), "four breaths are too few"
    nothing = dataclasses.replace(seen, pressure=np.full(holes.shape, np.nan))
    assert locate(nothing, pressure, SD, flow, volume) == ()


def test_equal_input_gives_equal_places():
    one, two = (with_error(11, lambda b: 0.2 * (b.u_out == 1)) for _ in range(2))
    assert one == two
    assert one


def test_p_values_against_all_flips_of_few_breaths():
    """Five breaths have 32 sign patterns: the exact probability can be counted."""
    values = np.random.default_rng(1).standard_normal((5, 3)) + 0.5
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 5)).reshape(5, -1).T
    scale = np.sqrt((values**2).sum(axis=0))
    largest = np.abs(signs @ values / scale).max(axis=1)
    seen = np.abs(values.sum(axis=0) / scale)
    exact_p = (largest[:, None] >= seen - 1e-12).mean(axis=0)
    found = p_values(values, two_sided=True, seed=0)
    np.testing.assert_allclose(found, exact_p, atol=0.03)


def test_the_statistic_rises_with_students_t():
    rng = np.random.default_rng(2)
    values = rng.standard_normal((12, 50)) + rng.standard_normal(50)
    t = values.mean(axis=0) / (values.std(axis=0, ddof=1) / np.sqrt(12))
    z = statistic(values)
    np.testing.assert_allclose(t, z * np.sqrt(11.0) / np.sqrt(12.0 - z**2))
    values[:8, 0] = np.nan
    assert statistic(values)[0] == 0.0, "four breaths are too few"


def test_samples_are_sorted_by_what_acted_before_them():
    recorded, pressure, flow, volume = exact(12, n=6)
    by_name = {axis.name: axis for axis in axes(recorded, pressure, flow, volume)}
    inspired = by_name["time since inspiration"]
    ends = np.argmax(recorded.u_out == 1, axis=1)
    for i, end in enumerate(ends):
        assert inspired.bins[i, end] == 10, "the first sample of expiration ends inspiration"
        assert inspired.bins[i, end + 1] == -1
        assert by_name["time since expiration"].bins[i, end + 1] == 0
    opening = by_name["valve opening"]
    i, j = 2, 5
    k = opening.bins[i, j]
    assert opening.edges[k] <= recorded.u_in[i, j - 1] < opening.edges[k + 1]
    assert by_name["flow"].bins[i, j] >= 0
    assert by_name["breath number"].edges.tolist() == [-1, 0, 1, 3, 4, 5]


def test_time_since_an_edge():
    recorded, *_ = exact(13, n=2)
    u_in = np.zeros((2, 80))
    u_in[:, 10:20] = 30.0
    u_in[1] += np.linspace(0.0, 40.0, 80)  # half a percent a sample is no edge
    since = since_edge(dataclasses.replace(recorded, u_in=u_in, u_out=np.zeros((2, 80), np.int8)))
    assert np.isnan(since[:, :11]).all()
    time = recorded.time
    np.testing.assert_allclose(since[:, 11:21], time[:, 11:21] - time[:, [10]])
    np.testing.assert_allclose(since[:, 21:], time[:, 21:] - time[:, [20]])


def test_a_start_that_never_fades_takes_what_is_left_of_a_zero():
    recorded, pressure, _, _ = exact(2, n=6)
    off = np.linspace(-0.4, 0.6, 6)[:, None]
    seen = dataclasses.replace(recorded, pressure=pressure + off)
    stays, fades = np.ones_like(pressure), np.exp(-recorded.time / 0.1)
    for start, of_zero in ((stays, 0.0 * off), (fades, off)):
        _, sizes, of_start = of_breaths(seen, pressure, pressure - 5.0, start)
        np.testing.assert_allclose(sizes[:, 1:2], of_zero, atol=0.02)
        np.testing.assert_allclose(of_start, off * stays - of_zero, atol=0.02)


def test_a_flow_that_drives_is_at_rest_after_most_gas_has_left():
    recorded, _, _, _ = exact(3, n=4)
    flow = np.where(recorded.u_out == 1, -80.0 * np.exp(-(recorded.time - 1.0) / 0.3), 20.0)
    driven = dataclasses.replace(recorded, u_in=flow, u_out=np.zeros_like(recorded.u_out))
    quiet = quiet_samples(driven)
    assert quiet[recorded.time > 1.7].all()
    assert not quiet[recorded.time < 1.55].any()


def test_noise_of_a_flow_that_drives_makes_no_range_err():
    """It moves the pressure that a sample is sorted by as much as the error of the sample."""
    rng = np.random.default_rng(4)
    recorded, *_ = exact(4, n=20)
    flow = np.where(recorded.time < 1.0, 430.0, 0.0) * np.minimum(recorded.time / 0.5, 1.0)
    noisy = flow + rng.normal(0.0, 8.0, flow.shape)
    volume = np.cumsum(flow, axis=1)
    like = most_alike(dataclasses.replace(recorded, flow=noisy))
    assert (like != np.arange(20)).all()

    def places(error):
        pressure = 5.0 + 0.03 * flow + error + rng.normal(0.0, 0.1, flow.shape)
        seen = dataclasses.replace(recorded, u_in=noisy, pressure=pressure)
        return locate(seen, 5.0 + 0.03 * noisy, SD, noisy, volume, sorted_by=like)

    assert places(0.0) == ()
    assert {place.axis for place in places(0.3 * (flow > 330.0))} >= {"pressure", "flow"}


def test_no_range_ends_at_a_value_that_comes_again_and_again():
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.uniform(5.0, 40.0, 200), rng.normal(5.0, 0.1, 300)])[None]
    edges = round_edges(values, np.ones(values.shape, bool))
    np.testing.assert_allclose(edges, np.arange(2.5, 46.0, 5.0)[: len(edges)])


def test_ranges_end_at_round_numbers():
    values = np.linspace(3.0, 41.0, 500)[None]
    np.testing.assert_allclose(
        round_edges(values, np.ones((1, 500), bool)), np.arange(0.0, 46.0, 5.0)
    )
    assert len(round_edges(np.full((1, 9), 5.0), np.ones((1, 9), bool))) >= 2
    assert len(round_edges(np.full((1, 9), np.nan), np.ones((1, 9), bool))) == 2


def test_profiles_judge_one_simulator_along_the_ranges_of_another():
    recorded, pressure, flow, volume = exact(14)
    judged = pressure - 0.5 * (recorded.time < 0.2)
    for mine, wanted in ((None, 0.0), (judged, 0.5)):
        found = profiles(recorded, pressure, flow, volume, simulated=mine)
        (start,) = [p for p in found if p.axis.name == "time since inspiration"]
        np.testing.assert_allclose(start.mean[:2], wanted, atol=1e-9)
        np.testing.assert_allclose(start.mean[2:10], 0.0, atol=1e-9)
        assert start.breaths[:10].tolist() == [60] * 10


def test_of_some_samples():
    recorded = np.array([[1.0, 2.0, np.nan, 4.0], [0.0, 0.0, 0.0, 0.0]])
    simulated = np.array([[1.0, 5.0, 7.0, 8.0], [9.0, 9.0, np.nan, 9.0]])
    mask = np.array([[True, True, True, True], [False] * 4])
    found = open_loop_error(recorded, simulated, mask)
    assert found.mae == pytest.approx((0.0 + 3.0 + 4.0) / 3)
    assert found.rmse == pytest.approx(np.sqrt((9.0 + 16.0) / 3))
    nothing = open_loop_error(recorded, simulated, ~mask & (np.arange(4) == 2))
    assert np.isnan(nothing.mae)
    assert np.isnan(nothing.rmse)


@pytest.fixture
def breaths():
    other = made.breaths("R5C10", n=4, seed=3)
    return join([made.breaths(n=4), dataclasses.replace(other, breath_id=other.breath_id + 100)])


def answers(breaths):
    """Off by a number in inspiration and by twice as much after it."""
    off = np.where(breaths.u_out == 1, 2.0, 1.0)
    return {
        name: breaths.pressure + k * off
        for name, k in (("before", 3.0), ("refit", 2.0), ("after", 1.0))
    }


def test_only_inspiration_of_held_out_breaths_counts(breaths):
    held = np.arange(8) % 4 == 1
    given = answers(breaths)
    for x in given.values():
        x[~held] += 100.0
        x[:, 0] += 100.0  # where every simulation starts
    found = compare_open_loop(breaths, Judge(breaths, held), given, 0.2)
    assert found.held_out_breaths == (2, 102)
    assert (found.before.mae, found.before.rmse) == pytest.approx((3.0, 3.0))
    assert (found.refit.mae, found.after.rmse) == pytest.approx((2.0, 1.0))
    assert found.noise_floor == 0.2
    assert found.groups["expiration"]["refit"].mae == pytest.approx(4.0)


def test_a_breath_that_starts_wrong_is_no_error_of_the_simulator(breaths):
    """Its first reading is off, and every simulation starts there."""
    inspired = (breaths.u_out == 0).astype(float)
    judge, start = Judge(breaths, np.ones(8, bool)), inspired[..., None]
    rng, quiet = np.random.default_rng(0), quiet_samples(breaths)
    predicted = breaths.pressure + 0.1 * rng.standard_normal(breaths.pressure.shape)
    assert judge.excess(predicted, start, quiet).p_value == 1.0
    predicted[3] += 8.0 * inspired[3]
    assert judge.excess(predicted, start, quiet).p_value == 1.0
    predicted[5] += 3.0 * inspired[5] * np.sin(6.0 * breaths.time[5])
    assert judge.excess(predicted, start, quiet).p_value < 0.01, "no start explains that"


def test_what_is_known_to_scatter_is_not_unexplained(breaths):
    """Neither gains that differ nor the noise of the reading that each breath starts from."""
    judge, given = Judge(breaths, np.ones(8, bool)), answers(breaths)
    given["after"] = breaths.pressure + 1.0
    scatter, start = np.full(breaths.pressure.shape, 0.9), np.full(breaths.pressure.shape, 2.0)
    found = compare_open_loop(breaths, judge, given, 0.1, scatter, start)
    assert found.scatter_error == pytest.approx(0.9)
    assert found.noise_floor == pytest.approx(0.1 * np.sqrt(5.0))
    assert found.unexplained == pytest.approx(np.sqrt(1.0 - 0.81 - 0.05))
    assert compare_open_loop(breaths, judge, given, 0.1).unexplained == pytest.approx(0.99**0.5)


def test_parts_of_the_breath_and_lungs(breaths):
    held = np.ones(8, bool)
    given = answers(breaths)
    early = breaths.time <= 0.2
    given["after"][early] += 4.0
    given["before"][breaths.lung_ids == "R5C10"] += 5.0
    found = compare_open_loop(breaths, Judge(breaths, held), given, 0.2)
    assert list(found.groups) == [
        "whole breath",
        "first 0.2 s of inspiration",
        "rest of inspiration",
        "expiration",
        "lung R5C10",
        "lung R20C50",
    ]
    assert found.groups["first 0.2 s of inspiration"]["after"].mae == pytest.approx(5.0)
    assert found.groups["rest of inspiration"]["after"].mae == pytest.approx(1.0)
    assert found.groups["lung R5C10"]["before"].mae == pytest.approx(8.0)
    assert found.groups["lung R20C50"]["before"].mae == pytest.approx(3.0)
    # Parts together are the whole.
    inside = breaths.inspiratory & (breaths.time > 0)
    error = (given["after"] - breaths.pressure)[inside]
    assert found.after.rmse == pytest.approx(np.sqrt(np.mean(error**2)))


def test_one_lung_is_no_part_and_gaps_do_not_count(breaths):
    one = breaths.select(np.arange(4))
    pressure = one.pressure.copy()
    pressure[:, 10:15] = np.nan
    given = answers(one)
    given["after"][2] = np.nan
    given["after"][:, 10:15] = 1e6
    holes = dataclasses.replace(one, pressure=pressure)
    found = compare_open_loop(holes, Judge(holes, np.ones(4, bool)), given, 0.2)
    assert not [name for name in found.groups if name.startswith("lung")]
    assert found.after.mae == pytest.approx(1.0)


def test_sentence_and_chart_have_one_mean():
    """A breath that stays long in a range counts no more there than one that stays short."""
    recorded, pressure, flow, volume = exact(11, n=40)
    late = (recorded.time > 0.5) & (np.arange(40) < 8)[:, None]
    error = np.where(late, -0.9, np.where(recorded.time < 0.1, 0.6, 0.25))
    noise = coloured(np.random.default_rng(12), pressure.shape, 0.0)
    seen = dataclasses.replace(recorded, pressure=pressure + error + noise)
    drawn = {p.axis.name: p for p in profiles(seen, pressure, flow, volume)}
    places = locate(seen, pressure, SD, flow, volume)
    checked = 0
    for place in places:
        if place.axis not in drawn:
            continue
        profile = drawn[place.axis]
        first = place.low - (place.axis == "breath number")
        inside = (profile.axis.edges[:-1] >= first - 1e-9) & (
            profile.axis.edges[1:] <= place.high + 1e-9
        )
        if inside.sum() == 1:
            assert place.mean_error == pytest.approx(float(profile.mean[inside][0]), abs=1e-9)
            checked += 1
    assert checked


def test_the_noise_is_the_sensors_not_that_of_a_bad_fit():
    recorded, pressure, *_ = exact(13, n=30)
    usable, quiet = recorded.valid, quiet_samples(recorded)
    error = coloured(np.random.default_rng(14), pressure.shape, 0.6)
    assert excess_over_noise(error, usable, quiet).noise == pytest.approx(SD, rel=0.1)
    sign = np.where(np.arange(30) % 2, 1.0, -1.0)[:, None]
    bad = 2.5 * sign * np.sin(np.pi * recorded.time) * (recorded.time < 1.0)
    found = excess_over_noise(error + bad, usable, quiet)
    assert found.noise == pytest.approx(SD, rel=0.2)
    assert found.p_value < 0.01
    moves = usable & ~quiet
    assert found.size == pytest.approx(np.sqrt(np.mean(bad[moves] ** 2)), rel=0.1)
    everywhere = excess_over_noise(error, usable, np.zeros_like(quiet))
    assert everywhere.noise < 0.8 * SD, "nothing is quiet: what neighbours share is none"
