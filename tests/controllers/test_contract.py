"""What every controller must hold. The cases are made from the registry of controller families.

A new family is one file and one line in the registry, as the last test shows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from ventbench.base.compilation import float64
from ventbench.controllers import residual
from ventbench.controllers.pid import PID
from ventbench.plants.single_compartment import single_compartment
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.interfaces import Controller, Observation
from ventbench.task.lungs import lung
from ventbench.task.rollouts import Inspirations, Script, closed_loop

PIPS = np.array([15.0, 20.0, 35.0])
LUNG = lung("R20C20")


def _residual() -> Controller:
    like = residual.Residual(PID(2.0, 4.0, 0.3), ())
    new = residual.untrained(jax.random.key(0), like, (8,))
    *hidden, (weights, biases) = new.layers
    # An untrained network corrects nothing: its last layer is zero.
    return new.replace(layers=(*hidden, (weights + 0.1, biases + 0.05)))  # type: ignore[attr-defined]


def _script() -> Controller:
    steps = jnp.arange(protocol.BREATHS * protocol.INSPIRATION_STEPS) % protocol.INSPIRATION_STEPS
    return Script(60.0 / (1.0 + steps))


def _policy(kind: type, outputs: int) -> Controller:
    network = residual.TanhNetwork((8,), outputs, first=0.2)
    return kind(residual.init_parameters(network, jax.random.key(1)), network)


#: Makes a controller of each family, in the precision that is in force.
CONTROLLERS: dict[str, Callable[[], Controller]] = {
    "pid": lambda: PID(2.0, 4.0, 0.3),
    "residual": _residual,
    "gaussian_policy": lambda: _policy(residual.GaussianPolicy, 1),
    "greedy_policy": lambda: _policy(residual.GreedyPolicy, len(residual.CHOICES)),
    "script": _script,
}


def run(controller: Controller, pips: np.ndarray = PIPS) -> Inspirations:
    inspirations, _ = closed_loop(single_compartment(LUNG), controller, nominal_scenario(pips))
    return jax.tree.map(np.asarray, inspirations)


def check(make: Callable[[], Controller]) -> None:
    """Raise AssertionError unless the controller keeps the contract."""
    with float64():
        controller = make()
        assert isinstance(controller, Controller)
        whole = run(controller)
        shape = (len(PIPS), protocol.BREATHS, protocol.INSPIRATION_STEPS)
        assert whole.requested.shape == shape
        assert np.all(np.isfinite(whole.requested))
        assert np.ptp(whole.requested) > 1.0, "it always asks for the same"

        # Its parameters are leaves, and it acts by them.
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(controller))
        scaled = jax.tree.map(lambda leaf: 1.1 * leaf, controller)
        assert not np.array_equal(run(scaled).requested, whole.requested)

        # The cells of a batch do not see each other, and a run has no memory of another one.
        turned = run(controller, PIPS[::-1].copy())
        np.testing.assert_allclose(turned.requested[::-1], whole.requested, rtol=0, atol=1e-9)
    # Its commands have the precision that is in force.
    single = make()
    leaves = jax.tree.leaves(single)
    assert run(single).requested.dtype == np.float32
    assert not any(jnp.asarray(leaf).dtype == jnp.float64 for leaf in leaves)


@pytest.mark.parametrize("make", CONTROLLERS.values(), ids=CONTROLLERS)
def test_a_family_keeps_the_contract(make):
    check(make)


@flax.struct.dataclass
class Proportional:
    """``u_in = bias + gain (target - pressure)``, %: a family made up for this test."""

    gain: float = 2.0
    bias: float = 5.0

    def init(self, shape: tuple[int, ...]) -> Array:
        return jnp.zeros(shape)

    def step(self, state: Array, observation: Observation) -> tuple[Array, Array]:
        return state, self.bias + self.gain * (observation.target - observation.pressure)


@flax.struct.dataclass
class Peeking(Proportional):
    """Every cell acts on the pressure of the first one: a family that breaks the contract."""

    def step(self, state: Array, observation: Observation) -> tuple[Array, Array]:
        pressure = jnp.broadcast_to(observation.pressure[0], observation.pressure.shape)
        return state, self.bias + self.gain * (observation.target - pressure)


def cases(registry: Mapping[str, Callable[[], Controller]]) -> list[str]:
    """Names of the families that keep the contract."""
    kept = []
    for name, make in registry.items():
        try:
            check(make)
        except AssertionError:
            continue
        kept.append(name)
    return kept


def test_one_line_in_the_registry_brings_a_family_under_the_contract(monkeypatch):
    for name in CONTROLLERS.copy():
        monkeypatch.delitem(CONTROLLERS, name)
    monkeypatch.setitem(CONTROLLERS, "proportional", Proportional)
    monkeypatch.setitem(CONTROLLERS, "peeking", Peeking)
    assert cases(CONTROLLERS) == ["proportional"]
