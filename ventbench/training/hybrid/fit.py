"""Fitting the inspirations: a robust loss and one Adam scan, compiled once for all members."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax import Array

from ventbench.plants.hybrid import Hybrid
from ventbench.training.hybrid.data import Inspirations
from ventbench.training.hybrid.parameters import Pooled, initial, plants
from ventbench.training.hybrid.priors import penalty

#: Iterations compiled into one scan; progress and Ctrl-C fall between two of them.
CHUNK = 20


@dataclass(frozen=True)
class Recipe:
    """How a member is fitted; hashable, as it is part of what is compiled.

    Attributes:
        iterations: of Adam, a multiple of ``CHUNK``.
        learning_rate: peak of the cosine schedule.
        softness: error below which the loss turns from absolute to square, cmH2O.
        saturation: breaths with a larger mean error count less and less, cmH2O.
        prior: weight of the prior, in breaths times cmH2O.
        reconstructed: weight of a reconstructed breath; a measured one has 1.
        R50: weight of a breath of a setting that is not scored.
        start_mean: belief about a first pressure that is blank, cmH2O.
        start_width: its standard deviation.
        directed: whether the direction of the command may have an effect.
    """

    iterations: int = 240
    learning_rate: float = 0.05
    softness: float = 0.1
    saturation: float = 2.0
    prior: float = 0.0135
    reconstructed: float = 0.4
    R50: float = 0.2
    start_mean: float = 6.2
    start_width: float = 0.7
    directed: bool = True


@flax.struct.dataclass
class Unknowns:
    """All that is fitted: the pooled parameters and first pressures (``(n,)``, cmH2O)."""

    pooled: Pooled
    start: Array


def simulate(plant: Hybrid, start: Array, data: Inspirations) -> Array:
    """Pressures at the end of each command of the inspirations, cmH2O, ``(n, SAMPLES - 1)``."""

    def step(state: Any, command: tuple[Array, Array]) -> tuple[Any, Array]:
        u_in, dt = command
        return plant.step(state, u_in, jnp.zeros_like(u_in), dt)

    _, pressure = jax.lax.scan(step, plant.init(start), (data.u_in.T, data.dt.T))
    return pressure.T


def errors(unknowns: Unknowns, data: Inspirations, recipe: Recipe) -> Array:
    """Simulated minus recorded pressure, cmH2O, 0 where none counts, ``(n, SAMPLES - 1)``."""
    plant = plants(unknowns.pooled, data.groups, directed=recipe.directed)
    start = jnp.where(data.start_known > 0, data.start, unknowns.start)
    return jnp.where(data.share > 0, simulate(plant, start, data) - data.pressure, 0.0)


def loss(unknowns: Unknowns, data: Inspirations, weight: Array, recipe: Recipe) -> Array:
    """Robust mean error and prior; ``weight`` has shape ``(n,)``."""
    soft, saturation = recipe.softness, recipe.saturation
    error = errors(unknowns, data, recipe)
    breath = jnp.sum(data.share * (jnp.sqrt(error**2 + soft**2) - soft), axis=1)
    breath = saturation * jnp.log1p(breath / saturation)
    starts = jnp.sum((unknowns.start - recipe.start_mean) ** 2) / recipe.start_width**2
    prior = penalty(unknowns.pooled) + 0.5 * starts
    return (jnp.sum(weight * breath) + recipe.prior * prior) / jnp.sum(weight)


def _optimiser(recipe: Recipe) -> optax.GradientTransformation:
    peak, warm_up = recipe.learning_rate, min(30, recipe.iterations // 4)
    return optax.adam(
        optax.warmup_cosine_decay_schedule(
            0.1 * peak, peak, warm_up, recipe.iterations, 0.01 * peak
        )
    )


@partial(jax.jit, static_argnames="recipe")
def _advance(
    carry: tuple[Unknowns, Any], data: Inspirations, weight: Array, recipe: Recipe
) -> tuple[tuple[Unknowns, Any], Array]:
    optimiser = _optimiser(recipe)

    def iterate(carry: tuple[Unknowns, Any], _: None) -> tuple[tuple[Unknowns, Any], Array]:
        unknowns, state = carry
        value, gradient = jax.value_and_grad(loss)(unknowns, data, weight, recipe)
        updates, state = optimiser.update(gradient, state)
        unknowns = jax.tree.map(jnp.add, unknowns, updates)
        return (unknowns, state), value

    return jax.lax.scan(iterate, carry, None, length=CHUNK)


def fit(
    data: Inspirations,
    weight: Array,
    recipe: Recipe,
    progress: Callable[[int, float], None] | None = None,
) -> tuple[Pooled, float]:
    """Fit the pooled parameters; call it within :func:`ventbench.precision.float64`.

    Args:
        data: from :func:`~ventbench.training.hybrid.data.inspirations`.
        weight: of each breath, shape ``(n,)``; 0 leaves it out.
        recipe: how.
        progress: called with iterations done and the loss, cmH2O.

    Returns:
        The parameters and the loss.
    """
    unknowns = Unknowns(initial(), jnp.full_like(data.start, recipe.start_mean))
    carry = (unknowns, _optimiser(recipe).init(unknowns))  # pyright: ignore[reportArgumentType]
    value = jnp.inf
    for done in range(0, recipe.iterations, CHUNK):
        carry, values = _advance(carry, data, weight, recipe)
        value = values[-1]
        if progress is not None:
            progress(done + CHUNK, float(value))
    return carry[0].pooled, float(value)


@partial(jax.jit, static_argnames="recipe")
def mean_absolute_errors(pooled: Pooled, data: Inspirations, recipe: Recipe) -> Array:
    """Open-loop error of each breath whose first pressure is known, cmH2O, ``(n,)``."""
    unknowns = Unknowns(pooled, jnp.full_like(data.start, recipe.start_mean))
    return jnp.sum(data.share * jnp.abs(errors(unknowns, data, recipe)), axis=1)
