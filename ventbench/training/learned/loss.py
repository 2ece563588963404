"""The loss: one-step first, then open-loop runs of growing length."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ventbench.plants.learned import Learned, LearnedState
from ventbench.training.learned.data import Inspirations
from ventbench.training.learned.recipe import Recipe


def horizon(recipe: Recipe, done: Array, steps: int) -> Array:
    """Open-loop steps between two measured windows, growing from 1 to the whole inspiration."""
    growth = max(1.0 - recipe.one_step - recipe.whole, 1e-6)
    share = jnp.clip((done - recipe.one_step) / growth, 0.0, 1.0)
    return jnp.where(share >= 1.0, steps + 1, jnp.floor(steps**share)).astype(jnp.int32)


def loss(
    nets: tuple[Any, Any],
    plant: Learned,
    batch: Inspirations,
    measured: Array,
    noise: Array,
    recipe: Recipe,
) -> Array:
    """Soft absolute error of the next pressures, cmH2O.

    Args:
        nets: the trained parts, ``(general, boundary)``.
        plant: the rest of the plant.
        batch: breaths.
        measured: where a run starts anew from the measured window, shape ``(n, T)``.
        noise: added to measured windows, cmH2O, shape of ``batch.window``.
        recipe: softness and penalty.
    """
    plant = dataclasses.replace(plant, general=nets[0], boundary=nets[1])
    closed = jnp.zeros_like(batch.start)

    def step(state: LearnedState, now: tuple[Array, ...]) -> tuple[LearnedState, Any]:
        u_in, dt, window, take = now
        # What was not measured is what the run itself predicted.
        state = dataclasses.replace(state, pressures=jnp.where(take, window, state.pressures))
        if recipe.rising == 0:
            state, pressure = plant.step(state, u_in, closed, dt)
            return state, (pressure, closed)
        (state, pressure), (_, slope) = jax.jvp(
            lambda u: plant.step(state, u, closed, dt), (u_in,), (jnp.ones_like(u_in),)
        )
        return state, (pressure, slope)

    take = batch.known & measured[..., None]
    steps = (batch.u_in, batch.dt, batch.window + noise, take)
    _, (pressure, slope) = jax.lax.scan(
        step, plant.init(batch.start), jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), steps)
    )
    error = (pressure.T - batch.after) / recipe.softness
    cost = recipe.softness * (jnp.sqrt(1.0 + error**2) - 1.0)
    # Slopes in units of the whole valve: cmH2O per 100 %.
    cost = cost + recipe.rising * 100.0 * jnp.maximum(-slope.T, 0.0)
    return jnp.sum(batch.weight * cost) / jnp.maximum(jnp.sum(batch.weight), 1.0)
