"""What every plant must hold. The cases are made from the registry of plant families.

A family with a lung at its label is tried at the two ends of the scored settings and must behave
like physics; the others need an example here. What all six frozen simulators hold is in
``test_frozen_physics.py``. A new family is one line in the registry, as the last test shows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from jax import Array
from numpy.typing import ArrayLike

from ventbench.base.compilation import float64
from ventbench.entries import scoring
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.entries.folder import open_submission
from ventbench.physics import physics
from ventbench.plants import frozen
from ventbench.plants.catalog import load_simulators
from ventbench.plants.corrected import Corrected
from ventbench.plants.plant_files import FAMILIES, PlantFamily, save_plants
from ventbench.plants.rigs import Rigs
from ventbench.plants.sensed import Sensed, sensor
from ventbench.plants.single_compartment import single_compartment
from ventbench.task import protocol, waveform
from ventbench.task.interfaces import Plant, Signals
from ventbench.task.lungs import LUNG_IDS, Lung, lung
from ventbench.task.rollouts import open_loop

#: The two ends of the scored settings.
STIFF_AND_SOFT = ("R5C10", "R20C50")


def official(lung_id: str) -> Plant:
    """Make one of the frozen simulators, in the precision in force."""
    plants = frozen.load().plants
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[LUNG_IDS.index(lung_id)]), plants)


def bent(lung_id: str) -> Plant:
    """Make a physics plant with turbulence."""
    return physics(lung(lung_id), {"turbulent_resistance": {"quadratic": 6.0}})


def corrected(lung_id: str) -> Plant:
    """Make a textbook lung that lacked turbulence."""
    label = lung(lung_id)
    return Corrected(single_compartment(label), bent(lung_id), physics(label))


def sensed(lung_id: str) -> Plant:
    """Make a textbook lung that is read through a bent sensor, as its pressure may jump."""
    return Sensed(single_compartment(lung(lung_id)), sensor({"sensor_curve.bend": 0.05}))


#: Plants of the families that need more than a label.
EXAMPLES = {
    "physics": {"R5C10": partial(bent, "R5C10")},
    "corrected": {"R20C50": partial(corrected, "R20C50")},
    "sensed": {"R20C50": partial(sensed, "R20C50")},
    "hybrid": {name: partial(official, name) for name in STIFF_AND_SOFT},
}


def cases(families: Mapping[str, PlantFamily]) -> dict[str, Callable[[], Any]]:
    """Make the plants to try, by family and lung; they are built anew in each precision."""
    found: dict[str, Callable[[], Any]] = {}
    for name, family in families.items():
        if family.for_lung is None:
            examples = EXAMPLES[name]
        else:
            examples = {x: partial(family.for_lung, lung(x)) for x in STIFF_AND_SOFT}
        found |= {f"{name}-{example}": make for example, make in examples.items()}
    return found


PLANTS = cases(FAMILIES)
TEXTBOOK = [name for name in PLANTS if not name.startswith("hybrid")]
FROZEN = [name for name in PLANTS if name.startswith("hybrid")]
PHYSICS = TEXTBOOK + FROZEN
#: Commands that hold PEEP while the expiratory valve is open, %: in the recordings, and so in what
#: has learned from them, PEEP is held by a resting flow of about 5 %, the protocol's own bias.
HOLDING = dict.fromkeys(PLANTS, 0.0) | dict.fromkeys(FROZEN, float(waveform.expiratory_command(99)))

T = 40
DT = np.full((1, T), protocol.DT)
every_plant = pytest.mark.parametrize("name", PLANTS)
physics_plant = pytest.mark.parametrize("name", PHYSICS)
textbook_plant = pytest.mark.parametrize("name", TEXTBOOK)


def pressures(
    plant: Plant, u_in, u_out=None, dt: ArrayLike = DT, start=protocol.PEEP
) -> np.ndarray:
    """Open-loop pressures, shape ``(n, T)``."""
    u_in = jnp.atleast_2d(jnp.asarray(u_in, float))
    u_out = jnp.zeros_like(u_in) if u_out is None else jnp.broadcast_to(u_out, u_in.shape) * 1.0
    start = jnp.broadcast_to(jnp.asarray(start, float), u_in.shape[:1])
    return np.asarray(
        open_loop(plant, start, u_in, u_out, jnp.broadcast_to(jnp.asarray(dt), u_in.shape))
    )


def breaths(count: int, u_in: float) -> tuple[np.ndarray, np.ndarray]:
    """Commands of whole breaths."""
    steps = np.arange(protocol.BREATH_STEPS)
    opened = (steps >= protocol.INSPIRATION_STEPS) * 1.0
    command = np.where(opened > 0, waveform.expiratory_command(steps), u_in)
    return np.tile(command, count)[None], np.tile(opened, count)[None]


@jax.jit
def expire(plant: Plant, start, u_in):
    """Pressure after 12 s of expiration from ``start`` to a PEEP of 5 cmH2O."""
    step = jnp.asarray(1.0), jnp.asarray(0.03)
    state, _ = plant.init(start, jnp.asarray(5.0))
    return jax.lax.scan(lambda s, _: plant.step(s, u_in, *step), state, length=400)[1].reading[-1]


@jax.jit
def gradients(plant: Plant, u_in):
    """By plant and command, of the mean pressure of an inspiration."""

    def mean(plant, u_in):
        dt = jnp.full((1, T), 0.03)
        return jnp.mean(open_loop(plant, jnp.full(1, 5.0), u_in, jnp.zeros((1, T)), dt))

    return jax.grad(mean, argnums=(0, 1))(plant, u_in)


@textbook_plant
def test_pressure_never_falls_as_the_valve_opens(name):
    levels = np.arange(0.0, 101.0)
    p = pressures(PLANTS[name](), np.repeat(levels[:, None], T, axis=1))
    assert np.all(np.diff(p, axis=0) >= -1e-4)
    assert np.all(np.diff(p, axis=1) >= -1e-4)


@physics_plant
def test_settles_when_the_valve_closes(name):
    p = pressures(PLANTS[name](), np.where(np.arange(T) < 10, 30.0, 0.0))
    assert np.ptp(p[0, 15:]) < 1e-3
    assert p[0, -1] > protocol.PEEP


@every_plant
@settings(max_examples=10)
@given(
    u_in=hnp.arrays(np.float32, (T,), elements=st.floats(0, 100, width=32)),
    u_out=hnp.arrays(np.int8, (T,), elements=st.integers(0, 1)),
)
def test_stays_finite_for_any_commands(name, u_in, u_out):
    assert np.all(np.isfinite(pressures(PLANTS[name](), u_in, u_out)))


@every_plant
def test_stays_finite_through_300_breaths_of_noise(name):
    _, opened = breaths(300, 0.0)
    u_in = np.random.default_rng(0).uniform(0, 100, opened.shape)
    p = pressures(PLANTS[name](), u_in, opened, dt=protocol.DT)
    assert np.all(np.isfinite(p))


@every_plant
@pytest.mark.parametrize("start", [0.0, 12.0, 35.0])
def test_expiration_returns_to_peep(name, start):
    pressure = expire(PLANTS[name](), jnp.asarray(start), jnp.asarray(HOLDING[name]))
    # The expiratory valve of the physics lets nothing in: a lung below PEEP stays there.
    end = min(start, 5.0) if name.startswith("physics") else 5.0
    assert float(pressure) == pytest.approx(end, abs=0.1 if name in FROZEN else 0.05)


@every_plant
def test_no_drift_over_300_breaths(name):
    u_in, u_out = breaths(300, 8.0)
    p = pressures(PLANTS[name](), u_in, u_out, dt=protocol.DT)[0]
    p = p.reshape(300, protocol.BREATH_STEPS)
    assert np.all(np.abs(p[20:] - p[20]) < 0.02)


@every_plant
def test_batched_equals_vmapped_equals_single(name):
    plant = PLANTS[name]()
    rng = np.random.default_rng(1)
    u_in = rng.uniform(0, 20, (4, T)).astype(np.float32)
    start = rng.uniform(2, 9, 4).astype(np.float32)
    opened, dt = np.zeros((4, T), np.float32), np.full((4, T), 0.03, np.float32)
    batched = np.asarray(open_loop(plant, *map(jnp.asarray, (start, u_in, opened, dt))))
    rows = [jnp.asarray(x)[:, None] for x in (start, u_in, opened, dt)]
    vmapped = np.asarray(jax.vmap(partial(open_loop, plant))(*rows))[:, 0]
    single = np.stack([pressures(plant, u_in[i], start=start[i])[0] for i in range(4)])
    np.testing.assert_allclose(vmapped, batched, atol=2e-4)
    np.testing.assert_allclose(single, batched, atol=2e-4)


@every_plant
def test_stacked_plants_are_each_their_own(name):
    plants = [PLANTS[name](), PLANTS[name]().vary(jnp.asarray(1.1), jnp.asarray(0.9))]
    stack = jax.tree.map(lambda *x: jnp.stack(x), *plants)
    run = partial(pressures, u_in=np.full(T, 6.0))
    commands = jnp.full((1, T), 6.0), jnp.zeros((1, T)), jnp.full((1, T), 0.03)
    together = jax.vmap(lambda p: open_loop(p, jnp.full(1, 5.0), *commands))(stack)
    np.testing.assert_allclose(together[0], run(plants[0]), atol=2e-4)
    np.testing.assert_allclose(together[1], run(plants[1]), atol=2e-4)


@pytest.mark.slow
@every_plant
def test_float32_agrees_with_float64(name):
    u_in = np.random.default_rng(2).uniform(0, 15, (2, T))
    single = pressures(PLANTS[name](), u_in)
    assert single.dtype == np.float32
    with float64():
        double = pressures(PLANTS[name](), u_in)
    assert double.dtype == np.float64
    np.testing.assert_allclose(single, double, atol=5e-4)


@pytest.mark.slow
@every_plant
def test_gradients_are_finite(name):
    by_plant, by_command = gradients(PLANTS[name](), jnp.full((1, T), 8.0))
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(by_plant))
    assert bool(jnp.all(jnp.isfinite(by_command)))
    # The real valve answers to a change and partly takes it back, so that there one command alone
    # may lower the mean.
    if name in TEXTBOOK:
        assert bool(jnp.all(by_command[:, :-1] > 0))


@textbook_plant
def test_half_steps_agree_with_whole_ones(name):
    rng = np.random.default_rng(3)
    u_in = rng.uniform(0, 15, (1, T))
    u_out = (np.arange(T) >= 25)[None] * 1.0
    with float64():
        plant = PLANTS[name]()
        whole = pressures(plant, u_in, u_out)
        halves = pressures(plant, *(np.repeat(x, 2, axis=1) for x in (u_in, u_out)), dt=0.015)
    # What is solved in substeps has half of them.
    atol = 5e-4 if name.startswith(("physics", "corrected")) else 2e-4
    np.testing.assert_allclose(halves[:, ::2], whole, atol=atol)


@every_plant
def test_nominal_variation_changes_nothing(name):
    plant = PLANTS[name]()
    one = jnp.asarray(1.0)
    u_in = np.random.default_rng(4).uniform(0, 15, (1, T))
    np.testing.assert_array_equal(pressures(plant, u_in), pressures(plant.vary(one, one), u_in))


@every_plant
def test_a_larger_gain_gives_more_pressure(name):
    plant, one = PLANTS[name](), jnp.asarray(1.0)
    u_in = np.full((1, T), 12.0)
    more = pressures(plant.vary(one, one, jnp.asarray(1.2)), u_in)
    assert np.all(more[..., 10] > pressures(plant, u_in)[..., 10] + 0.3)


@every_plant
def test_its_parameters_are_physics_that_answer_alike(name):
    plant = PLANTS[name]()
    known = plant.parameters()
    if known is None:
        assert name.startswith("two_balloon")
        return
    u_in = np.where(np.arange(T) < 20, 18.0, 12.0)
    said = physics(lung("R5C10")).having(**known)
    off = np.abs(pressures(said, u_in) - pressures(plant, u_in))
    # A learned rig knows more than the library; its parameters say most of it.
    assert off.max() < (4.0 if name in FROZEN else 0.05)
    varied = plant.vary(jnp.asarray(2.0), jnp.asarray(0.5)).parameters()
    assert varied is not None
    for path, factor in (("R", 2.0), ("C", 0.5)):
        np.testing.assert_allclose(varied[path], factor * known[path], rtol=1e-6)


@flax.struct.dataclass
class FirstOrder:
    """A toy family: pressure follows the command with a time constant; PEEP when the valve opens.

    All that a family needs: ``init``, ``step``, ``vary``, ``parameters``, a lung at its label.
    """

    gain: Array
    tau: Array

    def init(
        self, pressure: Array, peep: Array | None = None
    ) -> tuple[tuple[Array, Array], Signals]:
        pressure = jnp.asarray(pressure) * 1.0
        behind = pressure if peep is None else peep + 0.0 * pressure
        return (pressure, behind), Signals(pressure)

    def step(self, state, u_in, u_out, dt):
        pressure, peep = state
        goal = peep + (1.0 - u_out) * self.gain * u_in
        pressure = goal + (pressure - goal) * jnp.exp(-dt / self.tau)
        return (pressure, peep), Signals(pressure)

    def vary(self, r_scale, c_scale, gain=1.0):
        return FirstOrder(self.gain * r_scale * gain, self.tau * r_scale * c_scale)

    def parameters(self):
        return None


def first_order(label: Lung) -> FirstOrder:
    return FirstOrder(jnp.asarray(0.02 * label.R, float), jnp.asarray(0.1, float))


def test_a_new_family_is_one_file_and_one_line(make_recording, tmp_path, monkeypatch):
    monkeypatch.setitem(FAMILIES, "first_order", PlantFamily(FirstOrder, first_order))
    for name, make in cases({"first_order": FAMILIES["first_order"]}).items():
        monkeypatch.setitem(PLANTS, name, make)
        monkeypatch.setitem(HOLDING, name, 0.0)
        test_batched_equals_vmapped_equals_single(name)
        test_stacked_plants_are_each_their_own(name)
        test_expiration_returns_to_peep(name, 12.0)
        test_nominal_variation_changes_nothing(name)
    # It has a name for `--simulator`, and its plants go into files.
    simulators = load_simulators("first_order")
    recording = make_recording(["R5C10", "R20C50"])
    answers = simulators.pressures(recording)
    save_plants(tmp_path / "plants.json", {x: simulators.plant(x) for x in STIFF_AND_SOFT})
    again = load_simulators(tmp_path / "plants.json").pressures(recording)
    np.testing.assert_array_equal(again, answers)
    rigs = Rigs(simulators.lungs, simulators.stacked)
    score = scoring.run_protocol(
        open_submission("pid_best"), protocol_of(rigs, pips=(10.0,)), runner=InProcessRunner()
    )
    assert np.isfinite(score.score)
