"""Lower bounds of the error: commands optimised for each cell alone, with the lung known."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from numpy.typing import NDArray

from ventbench import environment as env
from ventbench import precision, protocol
from ventbench.environment import Scenario, nominal_scenario
from ventbench.interfaces import Plant

#: Steps that each start of the search opens the valve fully for, before it nearly closes it.
STARTS = (1, 2, 3, 5, 8, 14)

_STEPS = protocol.INSPIRATION_STEPS


def rise(plants: Plant, pips: tuple[float, ...] = protocol.PIPS) -> NDArray[np.float64]:
    """Error that the rise of the pressure costs: the valve is fully open from the first step on.

    No command brings more flow. If a higher command never means a lower pressure, no controller has
    a smaller error.

    Args:
        plants: leaves ``(L, ...)``.
        pips: cmH2O, P of them.

    Returns:
        Mean of the pressure that is missing to PIP, cmH2O, shape ``(L, P)``.
    """
    with precision.float64():
        cells = nominal_scenario(np.asarray(pips))
        lungs = jax.tree.leaves(plants)[0].shape[0]
        full = jnp.full((lungs, len(pips), _STEPS), protocol.U_MAX)
        pressures = _all_pressures(jax.tree.map(jnp.asarray, plants), cells, full)
        missing = np.maximum(np.asarray(pips)[:, None] - np.asarray(pressures), 0.0)
    return missing.mean(axis=-1)


def reached(
    plants: Plant, pips: tuple[float, ...] = protocol.PIPS, *, iterations: int = 600
) -> NDArray[np.float64]:
    """Least error that a gradient search finds for the commands of each cell, open loop.

    The search knows the simulator and its future, which no controller does.

    Args:
        plants: leaves ``(L, ...)``.
        pips: cmH2O, P of them.
        iterations: number of iterations of Adam, for each of :data:`STARTS`.

    Returns:
        cmH2O, shape ``(L, P)``.
    """
    errors = []
    with precision.float64():
        plants = jax.tree.map(jnp.asarray, plants)
        cells = nominal_scenario(np.asarray(pips))
        shape = (jax.tree.leaves(plants)[0].shape[0], len(pips), _STEPS)
        for opened in STARTS:
            start = jnp.broadcast_to(jnp.where(jnp.arange(_STEPS) < opened, 2.0, -2.5), shape)
            errors.append(np.asarray(_search(plants, cells, start, iterations)))
    return np.min(errors, axis=0)


def _pressures(plant: Plant, cells: Scenario, u_in: Array) -> Array:
    """Pressures of one inspiration, cmH2O, from commands, %; both ``(P, steps)``."""
    varied = env.vary(plant, cells)

    def step(loop: env.LoopState, u_in: Array) -> tuple[env.LoopState, Array]:
        after, _ = env.inspire(varied, cells, loop, u_in)
        return after, loop.pressure

    return jax.lax.scan(step, env.start_breath(varied, cells), u_in.T)[1].T


_all_pressures = jax.jit(jax.vmap(_pressures, (0, None, 0)))


def _errors(plants: Plant, cells: Scenario, free: Array) -> Array:
    """Error of each cell, ``(L, P)``; a sigmoid keeps commands in the valve's range."""
    pressure = _all_pressures(plants, cells, protocol.U_MAX * jax.nn.sigmoid(free))
    return jnp.mean(jnp.abs(pressure - cells.pip[:, None]), axis=-1)


@partial(jax.jit, static_argnames="iterations")
def _search(plants: Plant, cells: Scenario, start: Array, iterations: int) -> Array:
    optimiser = optax.adam(optax.cosine_decay_schedule(0.15, iterations))
    gradient = jax.grad(lambda free: _errors(plants, cells, free).sum())

    def iterate(carry: tuple[Array, Any], _: None) -> tuple[tuple[Any, Any], None]:
        free, state = carry
        updates, state = optimiser.update(jnp.nan_to_num(gradient(free)), state)
        return (optax.apply_updates(free, updates), state), None

    (free, _), _ = jax.lax.scan(iterate, (start, optimiser.init(start)), length=iterations)
    return _errors(plants, cells, free)
