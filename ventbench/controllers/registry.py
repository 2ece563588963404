"""The families of pure controllers: one line each adds a family to the contract tests."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from ventbench.controllers import residual, rl_policy
from ventbench.controllers.pid import PID
from ventbench.controllers.script import Script
from ventbench.task import protocol
from ventbench.task.interfaces import Controller


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
    network = rl_policy.TanhNetwork((8,), outputs, first=0.2)
    return kind(rl_policy.init_parameters(network, jax.random.key(1)), network)


#: Makes a controller of each family, in the precision that is in force.
CONTROLLERS: dict[str, Callable[[], Controller]] = {
    "pid": lambda: PID(2.0, 4.0, 0.3),
    "residual": _residual,
    "gaussian_policy": lambda: _policy(rl_policy.GaussianPolicy, 1),
    "greedy_policy": lambda: _policy(rl_policy.GreedyPolicy, len(rl_policy.CHOICES)),
    "script": _script,
}
