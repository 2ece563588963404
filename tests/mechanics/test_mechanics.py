"""Mechanics from pressure with flow or volume: closed-form breaths, whose answer is known."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy import integrate

from ventbench import mechanics
from ventbench.base.errors import InputError
from ventbench.mechanics.balance import leak
from ventbench.mechanics.labels import (
    Estimate,
    LungMatch,
    label_texts,
    match_label,
    session_fault,
    tolerance_text,
    value_text,
)
from ventbench.mechanics.segments import segments
from ventbench.recordings import Breaths, make_breaths
from ventbench.task.lungs import lung

SENSORS = ("flow", "volume")


def noise(rng, shape, sigma=0.2, rho=0.6):
    """First-order autoregressive."""
    out = rng.normal(0, sigma, shape)
    for t in range(1, shape[1]):
        out[:, t] = rho * out[:, t - 1] + np.sqrt(1 - rho**2) * out[:, t]
    return out


def recording(
    R=20.0,
    C=20.0,
    extra=None,
    *,
    n=10,
    seed=0,
    dt=0.01,
    jitter=0.0,
    sensors=SENSORS,
    peep=5.0,
    label=None,
    sigma=0.2,
    tube=0.0,
) -> Breaths:
    """Breaths of 3 s: volume rises and falls as Gaussians in time, so that flow is exact.

    ``extra(V, Q, slope, t, p)`` adds to the pressure, cmH2O; volumes in L. With a ``tube``, of
    mL/cmH2O, the sensor's flow has what that takes up too.
    """
    rng = np.random.default_rng(seed)
    steps = rng.uniform(dt - jitter, dt + jitter, (n, round(3.0 / dt)))
    t = np.concatenate([np.zeros((n, 1)), np.cumsum(steps, axis=1)], axis=1)
    size, a, b = (rng.uniform(*x, (n, 1)) for x in ((0.25, 0.5), (0.25, 0.45), (0.35, 0.55)))
    late = np.maximum(t - 1.2, 0.0)
    full = size * (1 - np.exp(-((np.minimum(t, 1.2) / a) ** 2)))
    falls = np.exp(-((late / b) ** 2))
    V = full * falls
    into, out = 2 * t / a**2, -2 * late / b**2
    Q = np.where(t < 1.2, into * (size - V), out * V)
    slope = np.where(t < 1.2, (2 / a**2 - into**2) * (size - V), (-2 / b**2 + out**2) * V)
    pressure = peep + R * Q + 1000.0 / C * V
    if extra is not None:
        pressure = pressure + extra(V, Q, slope, t, pressure)
    swallowed = tube / 1000.0 * (pressure - pressure[:, :1])
    shown = {
        "flow": 1000 * (Q + np.gradient(swallowed, axis=1) / np.gradient(t, axis=1)),
        "volume": 1000 * (V + swallowed),
    }
    shown = {name: x + rng.normal(0, 1.0, x.shape) for name, x in shown.items() if name in sensors}
    label = label or (R, C)
    return make_breaths(
        np.arange(n),
        np.full(n, label[0]),
        np.full(n, label[1]),
        t,
        np.zeros(t.shape),
        t >= 1.2,
        pressure + noise(rng, t.shape, sigma),
        flow=shown.get("flow"),
        volume=shown.get("volume"),
    )


def creep(ratio, time, C=20.0):
    """Stress of a Maxwell element, integrated in steps of a sample's hundredth."""

    def extra(V, Q, slope, t, p):
        out = np.zeros_like(V)
        for i in range(V.shape[1] - 1):
            h = t[:, i + 1] - t[:, i]
            rate = (V[:, i + 1] - V[:, i]) / h * ratio * 1000.0 / C
            decay = np.exp(-h / time)
            out[:, i + 1] = out[:, i] * decay + rate * time * (1 - decay)
        return out

    return extra


def only(breaths):
    (found,) = mechanics.identify(breaths)
    return found


def near(estimate, truth, share):
    assert estimate.value == pytest.approx(truth, rel=share)
    assert estimate.ci95[0] < estimate.ci95[1]


@pytest.mark.parametrize("sensors", [("flow",), ("volume",), SENSORS], ids="+".join)
@pytest.mark.parametrize("lung", [(5.0, 10.0), (20.0, 50.0), (50.0, 20.0)])
def test_R_and_C_of_a_plain_lung(lung, sensors):
    found = only(recording(*lung, sensors=sensors, seed=3))
    near(found.R, lung[0], 0.02)
    near(found.C, lung[1], 0.02)
    assert found.terms == ()
    assert found.match.label_matches
    assert found.match.settings[0] == found.label
    assert found.offset.ci95[0] - 0.1 < 5.0 < found.offset.ci95[1] + 0.1
    if "flow" in sensors:  # else the noise of the differentiated volume is in it
        assert found.noise == pytest.approx(0.2, rel=0.4)


def test_thirty_samples_a_second_with_jitter():
    found = only(recording(20.0, 20.0, dt=0.033, jitter=0.001, n=30, seed=2))
    near(found.R, 20.0, 0.02)
    near(found.C, 20.0, 0.02)
    assert found.terms == ()


@pytest.mark.slow
def test_intervals_hold_the_truth():
    inside = np.zeros(2)
    for seed in range(60):
        found = only(recording(20.0, 20.0, n=8, seed=100 + seed))
        for k, one in enumerate((found.R, found.C)):
            inside[k] += one.ci95[0] <= 20.0 <= one.ci95[1]
    assert np.all(inside >= 54)  # of 60; 57 are expected


@pytest.mark.parametrize(
    ("label", "truth"),
    [((20.0, 50.0), (20.0, 20.0)), ((5.0, 20.0), (20.0, 20.0)), ((50.0, 10.0), (5.0, 50.0))],
)
def test_a_wrong_label_is_found(label, truth):
    found = only(recording(*truth, label=label, seed=1))
    assert not found.match.label_matches
    assert found.match.label == f"R{label[0]:g}C{label[1]:g}"
    assert found.match.settings[0] == f"R{truth[0]:g}C{truth[1]:g}"
    assert len(found.match.settings) == 1
    assert found.match.source == "pressure and flow"


def test_a_lung_that_is_no_setting():
    found = only(recording(33.0, 33.0, label=(20.0, 20.0)))
    assert not found.match.label_matches
    assert found.match.settings == ()


CASES = {
    "turbulent_resistance": (
        lambda V, Q, slope, t, p: 6.0 * Q * np.abs(Q),
        "quadratic",
        6.0,
        0.1,
        {},
    ),
    "nonlinear_compliance": (
        # stiffening k: P = V / C + k / 2 (V / C)^2
        lambda V, Q, slope, t, p: 0.5 * 0.02 * (50.0 * V) ** 2,
        "stiffening",
        0.02,
        0.1,
        {},
    ),
    "viscoelasticity": (creep(0.4, 0.8), "ratio", 0.4, 0.3, {}),
    "inertance": (lambda V, Q, slope, t, p: 0.1 * slope, "inertance", 0.1, 0.1, {}),
    "direction_resistance": (
        lambda V, Q, slope, t, p: 5.0 * np.minimum(Q, 0.0),
        "difference",
        5.0,
        0.1,
        {},
    ),
    "volume_resistance": (lambda V, Q, slope, t, p: 15.0 * Q * V, "slope", 15.0, 0.1, {}),
    "circuit_compliance": (None, "compliance", 1.5, 0.15, {"tube": 1.5}),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_needed_beyond_R_and_C(name):
    extra, parameter, value, share, more = CASES[name]
    found = only(recording(20.0, 20.0, extra, n=20, seed=5, **more))
    assert [term.name for term in found.terms] == [name]
    near(found.terms[0].parameters[parameter], value, share)
    assert found.terms[0].nats > 4.6
    assert found.terms[0].effect > 0.03
    if name != "nonlinear_compliance":
        near(found.C, 20.0, 0.04)


def late_by(recorded: Breaths, lag: float) -> Breaths:
    """The recording with a pressure sensor of time constant ``lag``, s."""
    late = recorded.pressure.copy()
    for k in range(1, late.shape[1]):
        kept = np.exp(-recorded.dt[:, k - 1] / lag)
        middle = recorded.pressure[:, k - 1 : k + 1].mean(axis=1)
        late[:, k] = kept * late[:, k - 1] + (1 - kept) * middle
    return replace(recorded, pressure=late)


def test_a_late_sensor_is_told_beside_the_circuit_that_would_do_the_same():
    """One linear lung cannot tell them apart: R c of tubing is the time constant of a sensor."""
    (term,) = only(late_by(recording(20.0, 20.0, n=20, seed=5), 0.03)).terms
    assert term.name == "circuit_compliance"
    assert term.alternatives == ("sensor_lag",)


@pytest.mark.parametrize(("R", "quadratic", "lag"), [(20.0, 30.0, 0.03), (10.0, 0.0, 0.08)])
def test_a_sensor_that_no_circuit_could_delay_as_much_is_named(R, quadratic, lag):
    """A parabolic resistor tells the two apart, and so does a lag that would need 8 mL/cmH2O."""
    rohrer = lambda V, Q, slope, t, p: quadratic * Q * np.abs(Q)  # noqa: E731
    found = only(late_by(recording(R, 50.0, rohrer, n=20, seed=5, sigma=0.02), lag))
    terms = {term.name: term for term in found.terms}
    assert "circuit_compliance" not in terms
    near(terms["sensor_lag"].parameters["tau"], lag, 0.15)
    assert set(terms) <= {"sensor_lag", "turbulent_resistance"}
    near(found.C, 50.0, 0.05)


def leaking(plain: Breaths, conductance: float, zero: float = 0.0) -> Breaths:
    """A leak, mL/s per cmH2O, behind the sensor of flow, whose zero is off by some mL/s."""
    assert plain.flow is not None
    return replace(plain, volume=None, flow=plain.flow + conductance * plain.pressure + zero)


@pytest.mark.parametrize("conductance", [2.0, 5.0])
@pytest.mark.parametrize("quadratic", [0.0, 15.0])
def test_a_leak_is_gas_that_does_not_come_back(conductance, quadratic):
    """The sensor sees what leaks away behind it; a parabolic resistor changes nothing of that."""
    rohrer = lambda V, Q, slope, t, p: quadratic * Q * np.abs(Q)  # noqa: E731
    found = only(leaking(recording(20.0, 20.0, rohrer, n=8, seed=6), conductance))
    terms = {term.name: term for term in found.terms}
    assert set(terms) == {"leak"} | ({"turbulent_resistance"} if quadratic else set())
    assert terms["leak"].alternatives == ("flow_sensor_zero",)
    near(terms["leak"].parameters["conductance"], conductance, 0.15)
    near(found.R, 20.0, 0.05)
    near(found.C, 20.0, 0.05)


def test_a_zero_within_its_scatter_is_no_leak_and_a_leak_is_as_large_as_it_says():
    """Flow sensors whose zeros scatter by 5 mL/s: false alarms, and how often intervals hold."""
    rng = np.random.default_rng(3)
    false, held = 0, 0
    for seed in range(60):
        lung = rng.choice([5.0, 20.0, 50.0]), rng.choice([10.0, 20.0, 50.0])
        plain, zero = recording(*lung, n=8, seed=seed), rng.normal(0.0, 5.0)
        false += leak(segments(leaking(plain, 0.0, zero)))[1] is not None
        term = leak(segments(leaking(plain, 4.0, zero)))[1]
        assert term is not None
        low, high = term.parameters["conductance"].ci95
        held += low <= 4.0 <= high
    assert false <= 2
    assert held >= 54


def test_a_cough_and_pieces_of_breaths_are_no_leak():
    """Half of a breath does not give back what it took, and a cough throws out more."""
    plain = recording(20.0, 20.0, n=10, seed=4)
    assert plain.flow is not None
    flow, valid = plain.flow.copy(), plain.valid.copy()
    flow[3, 250:260] -= 1500.0
    valid[0, 120:] = False
    valid[9, 60:] = False
    breaths = replace(plain, flow=flow, volume=None, valid=valid)
    assert leak(segments(breaths))[1] is None
    term = leak(segments(leaking(breaths, 4.0)))[1]
    assert term is not None
    near(term.parameters["conductance"], 4.0, 0.2)
    inspirations = plain.valid & (plain.time < 1.2)
    assert leak(segments(replace(plain, volume=None, valid=inspirations)))[1] is None


@pytest.mark.parametrize("seed", [3, 4])
def test_pieces_of_breaths_between_missing_readings_are_no_leak(seed):
    """At 30 Hz, three missing readings of the flow part a breath where it holds gas."""
    plain = recording(45.0, 56.0, n=16, seed=seed, dt=1 / 30, sensors=("flow",), sigma=0.05)
    assert plain.flow is not None
    flow, rng = plain.flow.copy(), np.random.default_rng(seed)
    for breath in range(0, 16, 2):
        first = rng.integers(10, 70)
        flow[breath, first : first + 3] = np.nan
    found = only(replace(plain, flow=flow))
    assert found.terms == ()
    for truth, estimate in ((45.0, found.R), (56.0, found.C)):
        assert estimate.ci95[0] < truth < estimate.ci95[1]


def test_bad_readings_where_few_breaths_begin_are_no_delay_and_no_inertance():
    breaths = recording(32.0, 58.0, n=18, dt=0.02, sensors=("flow",), sigma=0.1)
    pressure = breaths.pressure.copy()
    pressure[[1, 10, 16], 2] += [44.0, -22.0, -23.0]
    assert only(replace(breaths, pressure=pressure)).terms == ()


@pytest.mark.slow
def test_nothing_is_found_where_nothing_is():
    rng = np.random.default_rng(0)
    false = 0
    for seed in range(50):
        lung = rng.choice([5.0, 20.0, 50.0]), rng.choice([10.0, 20.0, 50.0])
        sensors = (("flow",), ("volume",), SENSORS)[seed % 3]
        false += bool(only(recording(*lung, n=8, seed=seed, sensors=sensors)).terms)
    assert false <= 1


def test_gaps_partial_breaths_and_clipped_sensors():
    whole = recording(20.0, 20.0, n=12, seed=8)
    assert whole.flow is not None
    assert whole.volume is not None
    pressure, flow = whole.pressure.copy(), whole.flow.copy()
    pressure[2, 40:90] = np.nan
    flow[4, 100:160] = np.nan
    pressure[:, :] = np.minimum(pressure, 24.0)
    for volume in (whole.volume, None):
        found = only(replace(whole, pressure=pressure, flow=flow, volume=volume))
        near(found.R, 20.0, 0.03)
        near(found.C, 20.0, 0.03)
        assert "pressure saturate at 24 cmH2O" in " ".join(found.notes)
    # Parts of breaths only: the first second of some, nothing of others.
    valid = whole.valid.copy()
    valid[:4, 130:] = False
    valid[4:6, 20:] = False
    found = only(replace(whole, valid=valid))
    near(found.R, 20.0, 0.03)
    near(found.C, 20.0, 0.03)
    assert found.breaths == 10
    assert "2 of 12 breaths" in found.notes[0]


def test_several_lungs_and_few_breaths():
    two = [recording(5.0, 50.0, n=3, seed=1), recording(20.0, 10.0, n=6, seed=2)]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(x, name) for x in two])
        for name in ("R", "C", "time", "u_in", "u_out", "pressure", "flow")
    }
    found = mechanics.identify(make_breaths(np.arange(9), **columns))
    assert [one.label for one in found] == ["R5C50", "R20C10"]
    assert all(one.match.label_matches for one in found)
    assert "Fewer than 4 breaths" in found[0].notes[0]


def test_what_cannot_be_identified():
    whole = recording()
    with pytest.raises(InputError, match="neither flow nor volume"):
        mechanics.identify(replace(whole, flow=None, volume=None))
    with pytest.raises(InputError, match="no piece of a breath"):
        mechanics.identify(replace(whole, pressure=np.full_like(whole.pressure, np.nan)))


@pytest.mark.parametrize("factor", [1e-5, 1e-3, -1.0, 1e3])
def test_a_flow_in_another_unit_ends_in_an_answer(factor):
    """Square flow, 30 readings a second: where it jumps, R is wide by what the elastance says."""
    rng, time = np.random.default_rng(0), np.arange(90) * 0.033
    filling = 400.0 + 50.0 * np.sin(3.0 * time + np.arange(10)[:, None])
    volume = np.cumsum(np.where(time < 1.0, filling, 0.0), axis=1) * 0.033
    emptied = volume * np.exp(-np.maximum(time - 1.0, 0.0) / 0.4)
    flow = np.where(time < 1.0, filling, -emptied / 0.4)
    pressure = 5.0 + np.where(time < 1.0, 0.02 * filling + volume / 20.0, 0.025 * emptied)
    breaths = make_breaths(
        pressure=pressure + rng.normal(0.0, 0.05, pressure.shape),
        flow=factor * flow,
        time=np.broadcast_to(time, pressure.shape),
        u_in=np.zeros(pressure.shape),
        u_out=np.broadcast_to(time >= 1.0, pressure.shape).astype(float),
        breath_id=np.arange(10),
        R=np.full(10, 20.0),
        C=np.full(10, 20.0),
    )
    (answer,) = mechanics.identify(breaths)
    assert not answer.match.label_matches


def pretended(R, C, *, label=(20.0, 20.0), quadratic=0.0):
    """What a fit to pressure alone would say of one lung."""
    data = SimpleNamespace(lung=np.zeros(3, int), R=np.full(3, label[0]), C=np.full(3, label[1]))
    values = {"R": R, "C": C}
    return cast(
        Any,
        SimpleNamespace(
            problem=SimpleNamespace(data=data),
            value=lambda path: np.array([values[path]]),
            ci95=lambda path: np.array([[0.99 * values[path], 1.01 * values[path]]]),
            column=lambda path: np.full(3, quadratic),
        ),
    )


def label_match(fit):
    (match,) = mechanics.match_labels(fit)
    return match


def test_labels_by_pressure_alone():
    assert label_match(pretended(20.0, 20.0)).label_matches
    # A valve whose gain is 20 % off, on top of a lung that is 20 % off: R and 1/C together.
    assert label_match(pretended(28.0, 14.5)).label_matches
    # R and C off in the same direction: no gain explains that.
    other = label_match(pretended(31.5, 30.0))
    assert not other.label_matches
    assert other.settings == ()
    wrong = label_match(pretended(5.2, 51.0))
    assert not wrong.label_matches
    assert wrong.settings[0] == "R5C50"
    # A parabolic resistor has its label at 1 L/s.
    bent = label_match(pretended(6.0, 20.0, quadratic=13.0))
    assert bent.label_matches
    assert bent.fitted_R == 6.0
    assert bent.source == "pressure"
    # Noise knows R to 1 %; the equations, which leave out what every rig has a little of, do not.
    assert bent.ci95_R == pytest.approx((6.0 * 0.9691, 6.0 * 1.0319), rel=1e-3)
    open_end = pretended(0.5, 20.0)
    open_end.ci95 = lambda path: np.array([[0.0, 2.0] if path == "R" else [19.0, 21.0]])
    assert label_match(open_end).ci95_R == pytest.approx((0.0, 2.0), abs=1e-3)  # none is negative


@pytest.mark.parametrize(
    ("label", "R", "C"), [((5.0, 20.0), 10.0, 20.0), ((20.0, 20.0), 12.0, 20.0)]
)
def test_tolerances_do_not_add_up_to_another_lung(label, R, C):
    """R 10 for 5 and R 12 for 20 were taken: tubes, interval, gain and label at their ends."""
    assert not label_match(pretended(R, C, label=label)).label_matches
    assert not label_match(pretended(20.0, 34.0, label=(20.0, 50.0))).label_matches


@pytest.mark.parametrize("of_C", [(19.0, 21.0), (9.0, 11.0)])
def test_an_unknown_resistance_contradicts_no_label(of_C):
    """R 1 [0, 200] "does not match" said more than the fit knew."""
    R, C = Estimate(1.0, "cmH2O/(L/s)", (0.0, 200.0)), Estimate(20.0, "mL/cmH2O", of_C)
    match = match_label(lung("R5C20"), lambda _: R, C, "pressure", 1.2)
    assert not match.label_matches
    assert label_texts(match)[0] == "unknown"


def one_way(breaths: Breaths) -> Breaths:
    """The flow sensor has no sign: what leaves is counted as coming in."""
    assert breaths.flow is not None
    return replace(breaths, flow=np.abs(breaths.flow), volume=None)


def reversed_sign(breaths: Breaths) -> Breaths:
    assert breaths.flow is not None
    return replace(breaths, flow=-breaths.flow, volume=None)


def other_unit(breaths: Breaths) -> Breaths:
    assert breaths.flow is not None
    return replace(breaths, flow=breaths.flow * 0.001, volume=None)  # L/s


def unrelated(breaths: Breaths) -> Breaths:
    assert breaths.volume is not None
    return replace(breaths, flow=None, volume=np.roll(breaths.volume, 90, axis=1))


@pytest.mark.parametrize(
    ("harm", "how"),
    [
        (one_way, r"of \d+ mL that flow in, 0 mL are seen to leave"),
        (reversed_sign, r"the sign of the flow is reversed"),
        (other_unit, r"its unit may be another one"),
        (unrelated, r"volume"),
    ],
)
def test_what_no_lung_has_is_not_printed_but_explained(harm, how):
    found = only(harm(recording(20.0, 20.0, n=12, seed=5)))
    assert np.isnan([found.R.value, found.C.value, found.match.fitted_C]).all()
    assert not found.match.label_matches
    assert found.match.settings == ()
    assert re.search(how, found.notes[0]), found.notes[0]
    assert "No lung has the R and C" in found.notes[0]
    assert label_texts(found.match) == ("unknown", "unknown")
    assert value_text(found.match.fitted_C, found.match.ci95_C) == "unknown"


def test_a_label_that_holds_is_named_first_among_what_the_lung_may_be():
    """R10C10 lies within the tolerance of R5C10, R10C10 and R20C10 when R is little known."""
    known = ("R10C10", "R20C10")
    match = LungMatch("R10C10", 14.0, 10.0, (10.0, 18.0), (9.5, 10.5), True, "pressure", known)
    assert label_texts(match) == ("yes", "R10C10, or R20C10")
    wrong = replace(match, label_matches=False, settings=known[1:])
    assert label_texts(wrong) == ("no", "R20C10")
    assert "a factor of 1.3" in tolerance_text()


@pytest.mark.parametrize(
    ("of_R", "of_C", "matches", "informative"),
    [
        ((0.0, 200.0), (19.0, 21.0), False, False),
        ((19.0, 22.0), (5.0, 80.0), False, False),
        ((19.0, 22.0), (19.0, 21.0), True, True),
        ((50.0, 400.0), (19.0, 21.0), False, True),
    ],
)
def test_an_interval_that_says_nothing_matches_no_label(of_R, of_C, matches, informative):
    """Pattern 10: R of [0, 200] matched any label. An interval beyond it still contradicts it."""
    R, C = Estimate(20.0, "cmH2O/(L/s)", of_R), Estimate(20.0, "mL/cmH2O", of_C)
    match = match_label(lung("R20C20"), lambda _: R, C, "pressure")
    assert (match.label_matches, match.informative) == (matches, informative)
    told = "yes" if matches else "no" if informative else "unknown"
    assert label_texts(match)[0] == told


def test_the_label_comes_first_where_it_holds():
    found = only(recording(16.0, 20.0, label=(20.0, 20.0), seed=7))
    assert found.match.label_matches
    assert found.match.settings[0] == "R20C20"


def by_volume(R: float, C: float) -> Breaths:
    return recording(R, C, n=6, dt=0.03, sensors=("volume",), seed=3)


def read(breaths: Breaths, share: float = 1.0, late: int = 0) -> Breaths:
    """What a sensor reads that sees a share of the volume, and late by some samples."""
    assert breaths.volume is not None
    return replace(breaths, volume=share * np.roll(breaths.volume, late, axis=1))


def test_faults_of_a_session_belong_to_all_its_recordings():
    """A volume that reads 40 % makes R20C50 a lung that R50C20 would explain."""
    loose = [only(read(by_volume(R, 20.0), late=10)) for R in (5.0, 50.0)]
    weak, sound = only(read(by_volume(20.0, 50.0), 0.4)), only(by_volume(20.0, 20.0))
    assert label_texts(weak.match) == ("no", "R50C20")
    shared = mechanics.share_faults([*loose, weak, sound])
    assert label_texts(shared[2].match) == ("unknown", "R20C50")
    assert "2 of the 4 lungs of its session show flow or volume" in shared[2].notes[-1]
    assert shared[3] is sound, "what matches its label all the same is not doubted"
    assert mechanics.share_faults(shared)[2] is shared[2]
    # One bad recording among eight says nothing of the others.
    assert mechanics.share_faults([loose[0], weak, *[sound] * 6])[1] is weak


@pytest.mark.parametrize(("shown", "count", "stray"), [(0, 1, 0.05), (2, 3, 0.2), (5, 8, 0.05)])
def test_a_fault_of_a_session_by_bayes(shown, count, stray):
    def likely(share: float) -> float:
        return share**shown * (1.0 - share) ** (count - shown)

    by_fault = 0.05 * integrate.quad(likely, 0.0, 1.0)[0]
    expected = by_fault / (by_fault + 0.95 * likely(stray))
    assert session_fault(shown, count, stray) == pytest.approx(expected, rel=1e-9)
