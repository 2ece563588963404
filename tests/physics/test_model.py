"""The physics as a plant: contract, stability anywhere in range, precision, files."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.physics import library, parameter, paths, physics, resolution
from ventbench.plants.plant_files import load_plant, save_plant
from ventbench.plants.single_compartment import single_compartment
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNGS, Lung
from ventbench.task.rollouts import open_loop

N, T = 4, 50


def everything(lung=LUNGS[4], level="mild"):
    items = {m: item.description.parameters for m, item in library().items()}
    return physics(lung, {m: {p.name: getattr(p, level) for p in ps} for m, ps in items.items()})


def commands(seed=0, top=100.0):
    rng = np.random.default_rng(seed)
    u_out = np.broadcast_to(np.arange(T) % 25 >= 15, (N, T)) * 1.0
    drawn = rng.uniform(0, top, (N, T)) * (rng.uniform(size=(N, T)) < 0.8)
    return jnp.asarray(drawn), jnp.asarray(u_out), jnp.full((N, T), 0.032)


@pytest.mark.parametrize("lung", LUNGS, ids=str)
def test_base_is_the_textbook_lung(lung):
    """Solved there in closed form. Here the expiratory valve lets gas out only."""
    with compilation.float64():
        start = jnp.full(N, 6.0)
        mine = open_loop(physics(lung), start, *commands(top=20.0))
        textbook = open_loop(single_compartment(lung), start, *commands(top=20.0))
    np.testing.assert_allclose(mine, textbook, atol=2e-3, rtol=1e-4)


def test_nothing_enters_through_the_expiratory_valve():
    with compilation.float64():
        plant = physics(Lung(20.0, 20.0))
        start, zero = jnp.full(N, 4.0), jnp.zeros((N, T))
        state, _ = plant.init(start, jnp.full(N, 9.0))
        for _ in range(5):
            state, seen = plant.step(state, zero[:, 0], zero[:, 0] + 1.0, jnp.asarray(0.03))
    np.testing.assert_allclose(seen.reading, 4.0, atol=1e-9)


@pytest.mark.parametrize("quadratic", [0.0, 8.0])
def test_a_breath_may_begin_while_gas_flows(quadratic):
    """Under the flow that it begins with, the pressure goes on by the elastance alone."""
    R, C, flow, dt = 30.0, 40.0, 114.0, 0.02  # mL/s at a command of 5 %
    extra = {"turbulent_resistance": {"quadratic": quadratic}} if quadratic else {}
    with compilation.float64():
        plant = physics(Lung(R, C), extra).having(initial_flow=flow)
        u_in = jnp.full((1, T), 5.0)
        seen = open_loop(plant, jnp.asarray([9.0]), u_in, 0 * u_in, jnp.full((1, T), dt))
    np.testing.assert_allclose(np.asarray(seen)[0], 9.0 + flow * dt * np.arange(T) / C, atol=1e-6)


_RUN = jax.jit(lambda plant, start, *c: open_loop(plant, start, *c))


@settings(max_examples=60)
@given(st.data())
def test_stable_at_any_parameter_in_range(data):
    """Bounded pressures for any commands at the protocol's interval and at 2 and 100 ms."""
    names = [name for name in paths() if name != "PEEP"]
    shares = data.draw(st.lists(st.floats(0, 1), min_size=len(names), max_size=len(names)))
    extreme = data.draw(st.booleans())
    values = {}
    for name, share in zip(names, shares, strict=True):
        item = parameter(name)
        share = np.round(share) if extreme else share
        between = item.coordinate(item.low) * (1 - share) + item.coordinate(item.high) * share
        values[name] = float(np.clip(item.physical(between), item.low, item.high))
    dt = data.draw(st.sampled_from([0.002, 0.03, 0.1]))
    with compilation.float64():
        plant = physics(Lung(1.0, 1.0)).having(**values)
        u_in, u_out, _ = commands(data.draw(st.integers(0, 99)))
        p = np.asarray(_RUN(plant, jnp.full(N, 5.0), u_in, u_out, jnp.full((N, T), dt)))
    assert np.all(np.isfinite(p))
    # All gas ever given, in the stiffest lung, and the largest drop of the airway.
    gas = values["gain"] * 100 * dt * T / values["C"]
    flow = values["gain"] * 0.1
    # Gas with mass in a stiff circuit rings; softening and the sensor's gain are in range too.
    most = 50.0 * (gas + flow * (values["R"] + 80 * flow + 200) + 100.0)
    # What a tap adds as the lung empties through its own resistance.
    most += abs(values["tap_constriction.drop"]) * (most / values["R"]) ** 2
    assert np.abs(p).max() < most


@pytest.mark.slow
def test_gradients_are_finite_and_not_zero():
    """By every parameter, at neutral strengths and at mild ones."""
    with compilation.float64():
        start, c = jnp.full(N, 5.0), commands(top=30.0)
        c = (c[0] + 0.4, *c[1:])

        @jax.jit
        def slope(plant):
            return jax.grad(lambda p: jnp.mean(open_loop(p, start, *c) ** 2))(plant)

        for level in ("neutral", "mild"):
            # a breath after the steps of a session
            plant = everything(level=level).having(position=0.75, PEEP=5.0, gain=22.8, R_ex=5.0)
            by = dict(zip(plant.names, slope(plant).values, strict=True))
            assert all(np.isfinite(x) for x in by.values())
            dead = {name for name, x in by.items() if abs(x) < 1e-12}
            strengths = {
                f"{m}.{item.description.strength.name}"
                for m, item in library().items()
                # One without a slope where it is off must be scanned.
                if level == "mild" or not item.description.strength.scan
            }
            assert dead & (strengths | {"R", "C", "gain", "R_ex", "PEEP"}) == set(), level


def test_single_precision_agrees():
    found = []
    for context in (compilation.float32, compilation.float64):
        with context():
            u_in, u_out, dt = (jnp.asarray(np.asarray(x), float) for x in commands(top=30.0))
            found.append(np.asarray(open_loop(everything(), jnp.full(N, 5.0), u_in, u_out, dt)))
    assert found[0].dtype == np.float32
    np.testing.assert_allclose(found[0], found[1], atol=0.02)


@pytest.mark.slow
def test_half_the_interval_gives_the_same():
    """Commands held for two samples each, with all mechanisms that look at flows, not at edges."""
    with compilation.float64():
        u_in, u_out, dt = commands(top=20.0)
        whole = open_loop(everything(), jnp.full(N, 5.0), u_in, u_out, dt)
        twice = [jnp.repeat(x, 2, axis=1) for x in (u_in, u_out, dt / 2)]
        plant = replace(everything(), memory=12)
        halves = open_loop(plant, jnp.full(N, 5.0), *twice)[:, ::2]
    np.testing.assert_allclose(whole, halves, atol=0.15)
    assert resolution(0.032) == (5, 6)
    assert resolution(0.01) == (4, 16)


@pytest.mark.slow
def test_stacks_and_variations():
    with compilation.float64():
        stacked = everything().having(R=np.array([5.0, 20.0, 20.0, 50.0]))
        found = open_loop(stacked, jnp.full(N, 5.0), *commands(top=20.0))
        one = open_loop(everything(Lung(50.0, 20.0)), jnp.full(N, 5.0), *commands(top=20.0))
        np.testing.assert_allclose(found[3], one[3], rtol=1e-12)
        varied = everything().vary(jnp.asarray(1.1), jnp.asarray(0.9))
        assert float(varied.get("R")) == pytest.approx(22.0)
        assert float(varied.get("C")) == pytest.approx(18.0)
        assert float(varied.get("turbulent_resistance.quadratic")) == pytest.approx(4.4)
        assert float(varied.get("leak.conductance")) == pytest.approx(8.0)
        assert float(physics(LUNGS[0]).get("gain")) == pytest.approx(22.8)


def test_end_expiratory_pressure():
    """An explicit one counts most, then the parameter, then the start."""
    with compilation.float64():
        plant, start = physics(LUNGS[0], PEEP=7.0), jnp.asarray(5.0)
        assert float(plant.init(start)[0].peep) == 7.0
        assert float(plant.init(start, jnp.asarray(3.0))[0].peep) == 3.0
        assert float(physics(LUNGS[0]).init(start)[0].peep) == 5.0


def test_file_round_trip(tmp_path):
    with compilation.float64():
        plant = everything()
        save_plant(tmp_path / "plant.npz", plant)
        loaded = load_plant(tmp_path / "plant.npz")
        assert loaded.names == plant.names
        assert isinstance(loaded, Plant)
        c = jnp.full(N, 5.0), *commands(top=20.0)
        np.testing.assert_array_equal(open_loop(loaded, *c), open_loop(plant, *c))


def test_unknown_names():
    with pytest.raises(InputError, match=r"no parameter \['leak\.size'\]"):
        physics(LUNGS[0], {"leak": {"size": 1.0}})
