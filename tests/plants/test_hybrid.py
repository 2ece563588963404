"""The hybrid's steps against its differential equations, solved anew, and its parts by hand."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ventbench.base.compilation import float64
from ventbench.plants.hybrid import (
    DIRECTION_WIDTH,
    ELASTIC_KNOTS,
    MEMORY,
    PLAYS,
    RELIEF,
    RELIEF_ROOM,
    VALVE_KNOTS,
    Hybrid,
)
from ventbench.task.rollouts import open_loop

#: Practically no lag, s.
NONE = 1e-9


def hybrid(**changes) -> Hybrid:
    """A lung of about R20C20, without any effect of direction; float64 arrays."""
    values = dict(
        R=6.0,
        K2=12.0,
        E=50.0,
        stiffening=[-0.1, 0.3, 0.2, -0.2, 0.4],
        offset=0.3,
        slopes=0.02 + 0.01 * np.sin(np.arange(len(VALVE_KNOTS))),
        direction=np.zeros(len(PLAYS)),
        valve_delay=0.009,
        valve_lag=0.005,
        circuit_compliance=0.0009,
        sensor_lag=0.012,
        rising=0.0,
        falling=0.0,
        conductance=0.2,
        closing_conductance=0.1,
        opening_delay=0.011,
        closing_delay=0.0105,
        closing_lag=1e-9,  # at once
        rest=5.2,
    )
    assert set(changes) <= set(values)
    return Hybrid(**{name: np.asarray(x, float) for name, x in (values | changes).items()})  # type: ignore[arg-type]


def held(plant, u_in, u_out, dt, *, repeat=1, start=6.0):
    """Pressures at the end of each command, each given ``repeat`` times for ``dt / repeat``."""
    u_in, u_out = (np.repeat(np.append(x, 0.0), repeat)[None] for x in (u_in, u_out))
    with float64():
        found = open_loop(plant, np.full(1, start), u_in, u_out, np.full(u_in.shape, dt / repeat))  # type: ignore[arg-type]
    return np.asarray(found)[0, repeat::repeat][: (u_in.shape[1] // repeat) - 1]


def solved(plant: Hybrid, u_in, u_out, dt, start=6.0):
    """The same from the equations: volumes in circuit and lung, valve and sensor with lag."""
    p = {name: np.asarray(value) for name, value in vars(plant).items()}
    past_u, past_o, edges = [p["rest"], *u_in], [1.0, *u_out], dt * np.arange(len(u_in))

    def valve(u):
        widths = np.diff([*VALVE_KNOTS, np.inf])
        return float(np.dot(p["slopes"], np.clip(u - np.array(VALVE_KNOTS), 0.0, widths)))

    def recoil(volume):
        linear = p["E"] * volume
        above = np.maximum(linear - np.array(ELASTIC_KNOTS), 0.0)
        return linear + np.dot(p["stiffening"], above)

    def at(time, values):
        return values[np.searchsorted(edges, time, side="right")]

    def slopes(time, state):
        volume, pressure, flow, sensor = state
        opened_now = at(time, past_o)
        g, wait = (
            (p["conductance"], p["opening_delay"])
            if opened_now
            else (p["closing_conductance"], p["closing_delay"])
        )
        outlet = g * at(time - wait, past_o)
        behind = start - valve(p["rest"]) / g
        drop = pressure - recoil(volume)
        into_lung = np.sign(drop) * (
            2.0 * abs(drop) / (p["R"] + np.sqrt(p["R"] ** 2 + 4.0 * p["K2"] * abs(drop)))
        )
        out = outlet * (pressure - behind)
        return [
            into_lung,
            (flow - into_lung - out) / p["circuit_compliance"],
            (valve(at(time - p["valve_delay"], past_u)) - flow) / p["valve_lag"],
            (pressure - sensor) / p["sensor_lag"],
        ]

    # At rest the recoil is the pressure and the offset.
    volume = (start + p["offset"]) / p["E"]
    state, found, time = [volume, start, valve(p["rest"]), start], [], 0.0
    waits = [p[name] for name in ("valve_delay", "opening_delay", "closing_delay")]
    for end in edges + dt:
        stops = [x for x in np.sort(np.add.outer(waits, edges).ravel()) if time < x < end]
        for stop in [*stops, end]:
            solution = solve_ivp(
                slopes, (time + 1e-12, stop - 1e-12), state, method="LSODA", rtol=1e-9, atol=1e-11
            )
            state, time = solution.y[:, -1], stop
        found.append(state[3])
    return np.array(found)


rng = np.random.default_rng(0)
COMMANDS = np.round(rng.uniform(0.0, 50.0, 30), 1)
CLOSED = np.zeros(30)
BREATH = (np.arange(30) >= 16) * 1.0
LINEAR = {"K2": 0.0, "stiffening": np.zeros(5)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "u_out"),
    [
        (LINEAR, CLOSED),
        ({"K2": 40.0, "R": 1.0, "stiffening": np.zeros(5)}, CLOSED),
        ({"K2": 0.0}, CLOSED),
        ({}, CLOSED),
        ({}, BREATH),
        ({"closing_conductance": 0.4, "circuit_compliance": 0.003}, 1.0 - BREATH),
    ],
    ids=["linear", "turbulent", "stiffening", "all", "expiration", "closing"],
)
def test_small_steps_lead_to_the_differential_equations(changes, u_out):
    """The error is of first order: under white noise up to 50 %, 0.12 cmH2O at 2 ms at the most."""
    plant = hybrid(**changes)
    wanted = solved(plant, COMMANDS, u_out, 0.03)
    assert np.ptp(wanted) > 10.0
    # 2 and 5 ms: then the six samples that are remembered are longer than all dead times.
    fine, coarse = (held(plant, COMMANDS, u_out, 0.03, repeat=n) for n in (15, 6))
    np.testing.assert_allclose(fine, wanted, atol=0.15)
    assert np.abs(fine - wanted).max() < 0.5 * np.abs(coarse - wanted).max()
    limit = fine - (coarse - fine) * 2.0 / 3.0  # to a step of 0
    np.testing.assert_allclose(limit, wanted, atol=0.04)  # measured 0.027


def test_a_held_flow_into_a_linear_lung_is_exact_at_any_step():
    plant = hybrid(
        **LINEAR, offset=0.0, valve_delay=0.0, valve_lag=NONE, sensor_lag=NONE, closing_delay=0.0
    )
    for dt in (0.005, 0.03, 0.2):
        found = held(plant, np.full(20, 3.0), np.zeros(20), dt)
        time = dt * np.arange(1, 21)
        q = np.dot(plant.slopes[:3], np.diff(VALVE_KNOTS)[:3] * [1.0, 1.0, 1.0 / 1.5])
        c, e, r = plant.circuit_compliance, plant.E, plant.R
        rate = (1.0 / c + e) / r
        settled = q * r / (1.0 + e * c)
        drop = settled * (1.0 - np.exp(-rate * time))
        volume = settled / r * (time - (1.0 - np.exp(-rate * time)) / rate)
        np.testing.assert_allclose(found, 6.0 + e * volume + drop, rtol=1e-6)


def test_rests_where_it_starts():
    """The resting command through the open valve holds PEEP, whatever the lung."""
    plant = hybrid(offset=0.0, rising=0.4, falling=0.3, direction=[-0.3, -0.2, -0.1])
    p = held(plant, np.full(40, 5.2), np.ones(40), 0.03, start=7.0)
    np.testing.assert_allclose(p, 7.0, atol=1e-9)


def test_the_valves_curve_is_the_sum_of_its_slopes():
    plant = hybrid()
    with float64():
        flow = np.asarray(plant.valve(jnp.asarray([0.0, *VALVE_KNOTS[1:], 100.0])))
    edges = np.append(VALVE_KNOTS, 100.0)
    np.testing.assert_allclose(flow, np.append(0, np.cumsum(plant.slopes * np.diff(edges))))
    with float64():
        level = jnp.asarray(np.arange(0.0, 100.0, 0.25) + 0.1)
        slope = jax.vmap(jax.grad(plant.valve))(level)
    at = np.searchsorted(VALVE_KNOTS, level, side="right") - 1
    np.testing.assert_allclose(slope, plant.slopes[at])


def test_recoil_is_the_integral_of_its_slope():
    plant = hybrid()
    linear = np.linspace(0.0, 60.0, 6001)
    with float64():
        recoil, slope = (np.asarray(x) for x in plant.recoil(jnp.asarray(linear)))
    mean = 0.5 * (slope[1:] + slope[:-1])
    np.testing.assert_allclose(np.cumsum(mean) * 0.01, recoil[1:], atol=0.01)
    assert slope[0] == 1.0
    assert slope[-1] == pytest.approx(1.0 + plant.stiffening.sum())


_step = jax.jit(lambda plant, state, *command: plant.step(state, *command))


def run(plant, u_in, u_out=None, dt=0.03, start=5.0):
    """States and readings of single steps, in float64."""
    u_out = np.zeros(len(u_in)) if u_out is None else u_out
    with float64():
        (state, _), out = plant.init(jnp.asarray(start)), []
        for u, o in zip(u_in, u_out, strict=True):
            state, signals = _step(plant, state, *(jnp.asarray(float(x)) for x in (u, o, dt)))
            out.append((state, float(signals.reading)))
    return out


def test_the_direction_of_the_command_goes_through_plays():
    """A play follows the command only where it pushes; flow is the valve's at the sum."""
    weights = np.array([-0.4, -0.2, -0.1])
    plant = hybrid(direction=weights, valve_delay=0.0, valve_lag=NONE)
    u_in = [5.2, 6.0, 9.0, 30.0, 29.0, 24.0, 24.0, 25.0, 0.0, 0.0]
    plays = np.full(3, 5.2)
    for u, (state, _) in zip(u_in, run(plant, u_in), strict=True):
        for i, half in enumerate(PLAYS):
            if u - plays[i] > half:
                plays[i] = u - half
            elif plays[i] - u > half:
                plays[i] = u + half
        effective = u + np.dot(weights, plays - u)
        with float64():
            wanted = float(plant.valve(jnp.asarray(max(effective, 0.0))))
        assert float(state.flow) == pytest.approx(wanted, abs=1e-12)
        np.testing.assert_allclose([float(x) for x in state.plays], plays)
    # Rising to 24 % gives more flow than falling to it.
    up, down = (run(plant, [first, 24.0])[-1][0].flow for first in (10.0, 40.0))
    assert float(up) > float(down) + 0.05


def test_a_change_of_command_adds_to_the_reading_of_one_sample():
    plain, read = hybrid(), hybrid(rising=0.4, falling=0.3)
    u_in, u_out = [5.2, 9.0, 9.0, 8.9, 2.0, 2.0, 9.0], [0, 0, 0, 0, 0, 0, 1]
    added = [
        with_it[1] - without[1]
        for with_it, without in zip(run(read, u_in, u_out), run(plain, u_in, u_out), strict=True)
    ]
    small = -0.3 * np.tanh(0.1 / DIRECTION_WIDTH)
    np.testing.assert_allclose(added, [0, 0.4, 0, small, -0.3, 0, 0], atol=1e-6)


def test_dead_time_delays_by_whole_and_part_samples():
    plant = hybrid(valve_lag=NONE)
    with float64():
        high = float(plant.valve(jnp.asarray(20.0)))
        low = float(plant.valve(jnp.asarray(5.2)))
    for delay, reached in ((0.0, 0), (0.03, 1), (0.0449, 1), (0.06, 2)):
        u_in = [20.0] * 6
        flows = [float(s.flow) for s, _ in run(replace(plant, valve_delay=np.array(delay)), u_in)]
        np.testing.assert_allclose(flows, [low] * reached + [high] * (6 - reached), rtol=1e-6)


def test_a_dead_time_reaches_back_as_far_as_is_remembered():
    plant = hybrid(valve_lag=NONE, valve_delay=10e-3 * MEMORY)
    flows = np.array([float(s.flow) for s, _ in run(plant, [20.0] * 9, dt=0.01)])
    np.testing.assert_allclose(flows[:MEMORY], flows[0])
    np.testing.assert_allclose(flows[MEMORY:], flows[-1])
    assert flows[-1] > flows[0] + 0.1


def test_the_relief_holds_any_pressure_below_its_room():
    p = held(hybrid(), np.full(60, 100.0), np.zeros(60), 0.03)
    assert RELIEF < p.max() < RELIEF + RELIEF_ROOM
    assert (np.diff(p) > -1e-3).all()


def test_vary_is_a_lung_of_other_resistance_and_compliance():
    plant = hybrid(**LINEAR, offset=0.0, closing_delay=0.0)
    other = plant.vary(jnp.asarray(2.0), jnp.asarray(0.5))
    u_in = np.where(np.arange(60) < 10, 12.0, 0.0)
    p, q = (held(x, u_in, np.zeros(60), 0.03) - 6.0 for x in (plant, other))
    # Same volume into half the compliance and the circuit's.
    c, e = float(plant.circuit_compliance), float(plant.E)
    assert q[-1] / p[-1] == pytest.approx((1 / e + c) / (0.5 / e + c), rel=1e-6)
    assert (float(other.R), float(other.K2)) == (12.0, 0.0)
    turbulent = hybrid().vary(jnp.asarray(1.1), jnp.asarray(1.0))
    assert float(turbulent.K2) == pytest.approx(13.2)
    assert float(turbulent.E) == 50.0
