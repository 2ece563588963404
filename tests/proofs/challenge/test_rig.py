from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from scipy.linalg import expm

from hardware_eval.emulation.cases import EFFECTS, Base, Case, Effect, draw_base, draw_effect
from proofs.challenge.first.rig import record, replay, sampling_times, step_grid
from proofs.challenge.truth import has_library_form
from ventbench.recordings.breaths import make_breaths

from .truths import case

T = 48
STEPS = 32
TIME = np.linspace(0.0, (T - 1) * 0.032, T)
OPENED = (np.arange(T) >= 40).astype(np.int8)


def one_breath(u_in, u_out):
    """Commands of the first breath after a session of six; without pressures."""
    return make_breaths([7], [10.0], [20.0], TIME[None], u_in[None], u_out[None], 0 * TIME[None])


def driven(*effects, u=10.0, until=20, opened=OPENED, base=None):
    """One breath at a level command, then none; pressure, cmH2O, ``(T,)``, from near PEEP."""
    breath = one_breath(np.where(np.arange(T) < until, u, 0.0), opened)
    one = case(*effects, **({"base": base} if base else {}))
    return replay(one, breath, np.array([5.1]), 0, steps=STEPS)[0]


def test_plain_breath_is_the_closed_form():
    p = driven(until=40)
    R, C, R_ex, q = 10.0, 0.020, 5.0, 0.228
    rising = p[0] + q * TIME / C + R * q
    np.testing.assert_allclose(p[1:41], rising[1:41], atol=2e-5)
    inside = p[0] + q * TIME[40] / C - 5.0
    falling = 5.0 + inside * R_ex / (R + R_ex) * np.exp(-(TIME - TIME[40]) / (R + R_ex) / C)
    np.testing.assert_allclose(p[41:], falling[41:], atol=2e-5)


def test_flow_out_is_one_way():
    one = case(base=Base(10.0, 20.0, peep=5.0))
    p = replay(one, one_breath(np.zeros(T), np.ones(T, np.int8)), np.array([3.0]), 0)
    np.testing.assert_allclose(p, 3.0, atol=1e-9)


MIXED = [
    ("valve_lag", "valve_curve", "leak", "viscoelasticity"),
    ("valve_delay", "circuit_compliance", "turbulent_resistance", "exhalation_valve_delay"),
    ("supply_droop", "nonlinear_compliance", "sensor_lag", "patient_effort"),
    ("pulsating_supply", "volume_resistance", "cardiogenic", "direction_resistance"),
    ("inertance",),
    ("second_compartment",),
    ("expiratory_valve_orifice", "valve_hysteresis", "valve_dead_band", "sensor_nonlinearity"),
]


@pytest.mark.parametrize("names", MIXED, ids=",".join)
def test_half_the_step_changes_nothing(names):
    rng = np.random.default_rng(3)
    one = case(*(draw_effect(name, "strong", rng) for name in names), samples=45)
    recorded = record(one, np.random.default_rng(1), steps=8)
    steps = 320 if "inertance" in names else 128
    start = np.full(len(recorded), 5.0)
    usual = replay(one, recorded, start, 0, steps // 2)
    fine = replay(one, recorded, start, 0, steps)
    assert np.abs(usual - fine).max() < 0.005


EVERY = [(name, form) for name, entry in EFFECTS.items() for form in entry.forms]


@pytest.fixture(scope="module")
def plain():
    rng = np.random.default_rng(2)
    base = draw_base(5.0, 10.0, rng)
    one = Case("", 5.0, 10.0, base=base, noise=0.0, step=0.0, breaths=6, samples=45)
    breaths = record(one, rng, steps=8)
    return base, breaths, replay(one, breaths, np.full(6, base.peep), 0, steps=4)


@pytest.mark.parametrize(("name", "form"), EVERY)
def test_each_effect_is_there_and_stronger_is_more(plain, name, form):
    base, breaths, without = plain

    def change(strength):
        item = draw_effect(name, strength, np.random.default_rng(4), form)
        one = Case("", 5.0, 10.0, (item,), base, breaths=6)
        moved = replay(one, breaths, np.full(6, base.peep), 0, steps=4) - without
        return np.sqrt(np.mean(moved**2))

    mild, strong = change("mild"), change("strong")
    assert strong > 0.01
    same = EFFECTS[name].mild == EFFECTS[name].strong
    assert strong == mild if same else strong > 1.2 * mild


def test_dead_time_holds_the_pressure_back():
    late = Effect("valve_delay", "strong", "library", {"delay": 0.08})
    p, plain_p = driven(late), driven()
    np.testing.assert_allclose(p[:3], p[0], atol=1e-6)  # samples at 0, 32 and 64 ms
    gained = np.interp(TIME[4:20] - 0.08, TIME[1:], plain_p[1:])
    np.testing.assert_allclose(p[4:20], gained, atol=1e-4)


def test_expiratory_dead_time_holds_the_valve_shut():
    late = Effect("exhalation_valve_delay", "strong", "library", {"opening": 0.1})
    p = driven(late)
    np.testing.assert_allclose(p[41:44], p[40], atol=1e-6)
    assert p[44] < p[40] - 2


def test_leak_settles_where_it_takes_all_flow():
    item = Effect("leak", "strong", "library", {"conductance": 40.0})
    shut = np.zeros(T, np.int8)
    p = driven(item, u=5.0, until=T, opened=shut, base=Base(5.0, 3.0))
    # sqrt(p) = 114 mL/s / 40, but rounded off by 0.05 cmH2O near zero
    assert p[-1] == pytest.approx((114 / 40) ** 2, rel=0.01)


def test_circuit_shares_the_flow():
    item = Effect("circuit_compliance", "strong", "library", {"compliance": 3.0})
    p = driven(item)
    slope = (p[18] - p[12]) / (TIME[18] - TIME[12])
    assert slope == pytest.approx(0.228 / (0.020 + 0.003), rel=1e-3)


def test_stress_fades_while_volume_is_held():
    item = Effect("viscoelasticity", "strong", "library", {"ratio": 0.6, "time": 0.5})
    p = driven(item)
    held = p[0] + 0.228 * TIME[20] / 0.020
    faded = (p[39] - held) / (p[25] - held)
    assert faded == pytest.approx(np.exp(-(TIME[39] - TIME[25]) / 0.5), rel=1e-3)


def test_two_compartments_even_out():
    item = Effect("second_compartment", "strong", "two", {"share": 0.4, "time": 0.8})
    p = driven(item)
    C, R = np.array([0.012, 0.008]), np.array([5.0, 0.8 / 0.008])
    g, q = 1.0 / R, 0.228
    into = -np.diag(g / C) + np.outer(g, g / C) / g.sum()  # of volumes, at no flow in all
    within = np.zeros((3, 3))
    within[:2, :2], within[:2, 2] = into, q * g / g.sum()
    volumes = expm(within * TIME[20]) @ [*(p[0] * C), 1.0]
    held = expm(into * (TIME[35] - TIME[20])) @ volumes[:2]
    assert p[20] == pytest.approx(5.0 * q + (q + volumes[:2] @ (g / C)) / g.sum(), abs=1e-4)
    assert p[35] == pytest.approx(held @ (g / C) / g.sum(), abs=1e-4)
    assert p[35] < p[21] - 0.5


def test_turbulence_costs_by_the_square():
    item = Effect("turbulent_resistance", "strong", "library", {"quadratic": 10.0})
    np.testing.assert_allclose((driven(item) - driven())[1:21], 10.0 * 0.228**2, atol=1e-5)


def test_lung_reaches_its_capacity():
    item = Effect("nonlinear_compliance", "strong", "library", {"stiffening": 1 / 24})
    p = driven(item)
    start = 24.0 * (1.0 - np.exp(-p[0] / 24.0)) * 0.020
    volume = start + 0.228 * TIME[20]
    assert p[39] == pytest.approx(-24.0 * np.log(1.0 - volume / 0.020 / 24.0), abs=1e-3)


def test_lag_of_the_sensor_is_one_of_first_order():
    item = Effect("sensor_lag", "strong", "library", {"tau": 0.1})
    true, seen = driven(), driven(item)
    rate = (seen[26] - true[26]) / (seen[22] - true[22])  # while the volume is held
    assert rate == pytest.approx(np.exp(-4 * 0.032 / 0.1), rel=1e-3)


def test_valve_curve_loses_its_share_fully_open():
    def flow(form):
        item = Effect("valve_curve", "strong", form, {"loss": 0.5})
        p = driven(item, u=100.0, until=5, base=Base(10.0, 100.0))
        return (p[4] - p[2]) / (TIME[4] - TIME[2]) * 0.1

    assert flow("library") == pytest.approx(1.14, rel=1e-3)
    assert flow("tanh") == pytest.approx(1.14, rel=1e-3)
    assert flow("exponential") == pytest.approx(1.14, rel=1e-3)
    assert flow("convex") == pytest.approx(3.42, rel=1e-3)


def test_rounding_cuts_off():
    item = Effect("command_rounding", "strong", "library", {"amount": 1.0})
    np.testing.assert_allclose(driven(item, u=7.9), driven(u=7.0), atol=1e-9)


def test_a_recording_is_what_a_laboratory_would_have():
    one = Case("", 20.0, 20.0, breaths=8)
    breaths = record(one, np.random.default_rng(5), steps=16)
    assert breaths.pressure.shape == (8, 80)
    assert set(breaths.lung_ids) == {"R20C20"}
    np.testing.assert_allclose(breaths.pressure / 0.0703, np.round(breaths.pressure / 0.0703))
    np.testing.assert_allclose(breaths.u_in, np.round(breaths.u_in, 2))
    assert breaths.u_in.min() >= 0
    assert breaths.u_in.max() <= 100
    steps = np.diff(breaths.time, axis=1)
    assert 0.031 < steps.mean() < 0.0345
    assert 2e-4 < steps.std(axis=1).mean() < 4e-4
    assert np.all(np.diff(breaths.u_out, axis=1) >= 0)
    again = record(one, np.random.default_rng(5), steps=16)
    np.testing.assert_array_equal(breaths.pressure, again.pressure)


def test_strengths_vary_within_15_percent():
    rng = np.random.default_rng(6)
    drawn = [draw_effect("leak", "mild", rng).parameters["conductance"] for _ in range(50)]
    assert 8 * 0.85 <= min(drawn) < 8 * 0.9
    assert 8 * 1.1 < max(drawn) <= 8 * 1.15
    assert has_library_form(draw_effect("leak", "mild", rng))
    assert not has_library_form(draw_effect("leak", "mild", rng, "linear"))
    assert not has_library_form(draw_effect("cardiogenic", "mild", rng))


def test_it_shares_no_code_with_the_library():
    code = (
        "import sys; import proofs.challenge.make; "
        "print([m for m in sys.modules if m == 'jax' or m.startswith('ventbench.physics')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("seed", range(8))
def test_samples_keep_their_times_under_any_dead_times(seed):
    rng = np.random.default_rng(seed)
    u_out = np.zeros((3, 80), np.int8)
    u_out[:, 31:] = 1
    for _ in range(25):
        time = sampling_times(3, 80, 3e-4, rng)
        delay, opening_delay = (float(s) for s in rng.uniform(0.0, 0.12, 2))
        nodes = step_grid(time, u_out, delay, opening_delay, 8).nodes
        assert np.all(np.diff(nodes, axis=1) > 0)
        np.testing.assert_allclose(nodes[:, ::8], time, atol=0)
