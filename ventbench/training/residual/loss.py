"""The paper's objective, differentiable through controller and simulators."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from ventbench import environment as env
from ventbench import protocol
from ventbench.controllers.residual import Residual
from ventbench.interfaces import Plant
from ventbench.scenario import Scenario


@jax.custom_vjp
def valve(u_in: Array) -> Array:
    """Clip a command to the valve's range, %, with a derivative where it leads back into it."""
    return jnp.clip(u_in, 0.0, protocol.U_MAX)


def _valve_forward(u_in: Array) -> tuple[Array, Array]:
    return valve(u_in), u_in


def _valve_backward(u_in: Array, gradient: Array) -> tuple[Array]:
    # Beyond an end only what a step down the gradient can mend is told.
    stuck = ((u_in > protocol.U_MAX) & (gradient < 0)) | ((u_in < 0) & (gradient > 0))
    return (jnp.where(stuck, 0.0, gradient),)


valve.defvjp(_valve_forward, _valve_backward)


@flax.struct.dataclass
class Run:
    """One run of three inspirations; every array ``(..., BREATHS, INSPIRATION_STEPS)``.

    Attributes:
        pressure: true, cmH2O.
        correction: of the PID's command, %.
        u_in: command as applied, %.
    """

    pressure: Array
    correction: Array
    u_in: Array


def run(controller: Residual, plant: Plant, cell: Scenario) -> Run:
    """Run a controller.

    Args:
        controller: which.
        plant: one lung.
        cell: one cell, batch shape ``()``.
    """
    varied = env.vary(plant, cell)
    start = env.start_breath(varied, cell)

    def step(carry: tuple[Any, env.Bench], at: tuple[Array, Array]) -> tuple[Any, Run]:
        state, bench = carry
        breath, index = at
        # In one scan over all breaths: half the compilation of a scan of scans.
        bench = jax.tree.map(lambda new, old: jnp.where(index == 0, new, old), start, bench)
        seen = env.observe(cell, bench, breath, index)
        state, base, correction = controller.parts(state, seen)
        after, applied = env.inspire(varied, cell, bench, valve(base + correction))
        return (state, after), Run(bench.pressure, correction, applied)

    count = jnp.arange(protocol.BREATHS * protocol.INSPIRATION_STEPS)
    at = (count // protocol.INSPIRATION_STEPS, count % protocol.INSPIRATION_STEPS)
    _, found = jax.lax.scan(step, (controller.init(()), start), at)
    shape = (protocol.BREATHS, protocol.INSPIRATION_STEPS)
    return jax.tree.map(lambda x: x.reshape(shape), found)


def loss(
    controller: Residual, plants: Plant, cells: Scenario, first_breath: float, lam: float
) -> tuple[Array, Array]:
    """Mean of ``|pressure - PIP| + lam |correction|`` over inspirations and runs.

    Args:
        controller: which.
        plants: leaves ``(n, ...)``.
        cells: batch shape ``(n,)``.
        first_breath: weight of the first breath; the others have 1.
        lam: cmH2O for each %.

    Returns:
        The loss, cmH2O, and the applied commands, %, ``(n, BREATHS, INSPIRATION_STEPS)``.
    """
    found = jax.vmap(run, (None, 0, 0))(controller, plants, cells)
    scored = jnp.isin(jnp.arange(protocol.BREATHS), jnp.array(protocol.SCORED_BREATHS))
    weight = jnp.where(scored, 1.0, first_breath)[:, None]
    each = jnp.abs(found.pressure - cells.pip[:, None, None]) + lam * jnp.abs(found.correction)
    return jnp.mean(each * weight) / jnp.mean(weight), found.u_in


def disagreement(ensemble: Plant, cells: Scenario, u_in: Array) -> Array:
    """How far the members of an ensemble answer differently to the same commands.

    Args:
        ensemble: leaves ``(members, n, ...)``, two members at least.
        cells: batch shape ``(n,)``.
        u_in: of one inspiration, %, shape ``(n, INSPIRATION_STEPS)``.

    Returns:
        Sample standard deviation over members of the pressure, mean over steps and cells, cmH2O:
        the exploitation index, but for one breath.
    """

    def pressures(plant: Plant, cell: Scenario, u_in: Array) -> Array:
        varied = env.vary(plant, cell)

        def step(bench: env.Bench, u_in: Array) -> tuple[env.Bench, Array]:
            after, _ = env.inspire(varied, cell, bench, u_in)
            return after, bench.pressure

        return jax.lax.scan(step, env.start_breath(varied, cell), u_in)[1]

    each = jax.vmap(jax.vmap(pressures), (0, None, None))(ensemble, cells, u_in)
    variance = jnp.var(each, axis=0, ddof=1)
    # 1e-6 keeps the derivative finite where all members agree, as in the first step.
    return jnp.mean(jnp.sqrt(variance + 1e-6))
