"""A simulator corrected by what one physics adds to another."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.compilation import float64
from ventbench.physics import physics
from ventbench.plants import frozen
from ventbench.plants.corrected import Corrected
from ventbench.plants.plant_files import load_plants, save_plants
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import take
from ventbench.task.lungs import lung
from ventbench.task.rollouts import open_loop

LUNG = lung("R20C50")
T = 50


def commands(n=2):
    rng = np.random.default_rng(0)
    u_in = rng.uniform(0.0, 20.0, (n, T))
    u_out = np.broadcast_to(np.arange(T) >= 30, (n, T)) * 1.0
    return u_in, u_out, rng.uniform(0.030, 0.034, (n, T))


def run(plant, start=5.0):
    with float64():
        rows = (np.full(2, start), *commands())
        return np.asarray(open_loop(plant, *(jnp.asarray(x, float) for x in rows)))


def with_delay(**base):
    with float64():
        return physics(LUNG, {"valve_delay": {"delay": 0.04}}, **base)


@pytest.fixture(scope="module")
def base():
    with float64():
        return physics(LUNG)


@pytest.fixture(scope="module")
def textbook():
    with float64():
        return single_compartment(LUNG)


def test_where_both_physics_agree_it_is_the_simulator(base):
    with float64():
        simulator = take(frozen.load().plants, 3)
    wanted = run(simulator)
    np.testing.assert_allclose(run(Corrected(simulator, base, base)), wanted, atol=1e-9)
    late = with_delay()
    np.testing.assert_allclose(run(Corrected(simulator, late, late)), wanted, atol=1e-9)


def test_a_simulator_that_is_its_own_physics_becomes_what_is_wanted(base):
    wanted = run(with_delay())
    assert np.abs(wanted - run(base)).max() > 1.0
    np.testing.assert_allclose(run(Corrected(base, with_delay(), base)), wanted, atol=1e-9)


def test_what_is_added_is_the_difference(base, textbook):
    late = with_delay(gain=20.0)
    found = run(Corrected(textbook, late, base), start=7.0)
    parts = [run(plant, start=7.0) for plant in (textbook, late, base)]
    np.testing.assert_allclose(found, parts[0] + parts[1] - parts[2], atol=1e-9)
    assert np.all(found[:, 0] == 7.0)


def test_all_three_vary(base, textbook):
    scale = jnp.asarray(1.2), jnp.asarray(0.8)
    late = with_delay()
    with float64():
        varied = Corrected(textbook, late, base).vary(*scale)
        parts = [run(plant.vary(*scale)) for plant in (textbook, late, base)]
    np.testing.assert_allclose(run(varied), parts[0] + parts[1] - parts[2], atol=1e-9)
    assert np.abs(run(varied) - run(Corrected(textbook, late, base))).max() > 0.5


def test_peep_is_given_to_all_three(base, textbook):
    plant = Corrected(textbook, with_delay(), base)
    with float64():
        state, _ = plant.init(jnp.asarray(12.0), jnp.asarray(8.0))
        step = jnp.asarray(1.0), jnp.asarray(0.03)
        last = jax.lax.scan(lambda s, _: plant.step(s, jnp.asarray(0.0), *step), state, length=400)[
            1
        ]
    assert float(last.reading[-1]) == pytest.approx(8.0, abs=0.05)


def test_back_from_json_to_the_bit(base, textbook, tmp_path):
    plant = Corrected(textbook, with_delay(gain=21.3), base)
    path = tmp_path / "corrected.json"
    save_plants(path, {"R20C50": plant})
    found = load_plants(path)[0]["R20C50"]
    assert type(found) is Corrected
    assert jax.tree.structure(found) == jax.tree.structure(plant)
    assert np.array_equal(run(found), run(plant))


def stored_lung(resistance):
    fields = {"R": resistance, "C": 20.0, "gain": 20.0, "R_ex": 5.0}
    return {"type": "SingleCompartment", "fields": {k: {"value": v} for k, v in fields.items()}}


def test_files_name_the_two_physics_wanted_and_had(tmp_path):
    fields = {"simulator": stored_lung(5.0), "wanted": stored_lung(20.0), "had": stored_lung(10.0)}
    content = {
        "format": "ventbench-plants-1",
        "about": {},
        "lungs": {"R5C20": {"type": "Corrected", "fields": fields}},
        "arrays": {},
    }
    path = tmp_path / "corrected.json"
    path.write_text(json.dumps(content))
    plant = load_plants(path)[0]["R5C20"]
    assert isinstance(plant, Corrected)
    assert (plant.with_mechanisms.R, plant.without_mechanisms.R) == (20.0, 10.0)
    save_plants(tmp_path / "again.json", {"R5C20": plant})
    assert json.loads((tmp_path / "again.json").read_text()) == content
