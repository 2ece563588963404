"""Training of the learned plant."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from ventbench.plants.learned import Architecture, Learned, learned
from ventbench.resume import Checkpoint, fingerprint
from ventbench.training.learned.data import (
    Floats,
    Inspirations,
    expiratory_time_constant,
    inspirations,
    normalisation,
)
from ventbench.training.learned.loss import horizon
from ventbench.training.learned.loss import loss as open_loop_loss
from ventbench.training.learned.recipe import Progress, Recipe

#: Updates compiled into one scan; a checkpoint or a Ctrl-C falls between two of them.
CHUNK = 50


def _optimiser(recipe: Recipe) -> optax.GradientTransformation:
    warm = max(recipe.steps // 50, 1)
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, recipe.learning_rate, warm, max(recipe.steps, warm + 1)
    )
    return optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=recipe.weight_decay)
    )


@partial(jax.jit, static_argnames="recipe")
def _advance(
    carry: tuple[Any, Any],
    plant: Learned,
    data: Inspirations,
    key: Array,
    first: Array,
    recipe: Recipe,
) -> tuple[tuple[Any, Any], Array]:
    """``CHUNK`` updates, fewer at the end; returns the nets, the optimiser's state, mean loss."""
    optimiser = _optimiser(recipe)
    length = data.u_in.shape[1]

    def update(carry: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        nets, state = carry
        draw_key, phase_key, noise_key = jax.random.split(jax.random.fold_in(key, number), 3)
        rows = jax.random.randint(draw_key, (recipe.batch,), 0, data.count)
        batch = jax.tree.map(lambda x: x[rows] if x.ndim else x, data)
        reach = horizon(recipe, number / recipe.steps, length)
        phase = jax.random.randint(phase_key, (recipe.batch, 1), 0, reach)
        # A run over the whole inspiration takes no measured window but the start.
        measured = ((jnp.arange(length) + phase) % reach == 0) & (reach <= length)
        noise = recipe.noise * jax.random.normal(noise_key, batch.window.shape)
        loss, gradient = jax.value_and_grad(open_loop_loss)(
            nets, plant, batch, measured, noise, recipe
        )
        updates, state = optimiser.update(gradient, state, nets)
        new = (optax.apply_updates(nets, updates), state)
        last = number >= recipe.steps
        return jax.tree.map(lambda a, b: jnp.where(last, a, b), (nets, carry[1]), new), loss

    carry, losses = jax.lax.scan(update, carry, first + jnp.arange(CHUNK))
    inside = first + jnp.arange(CHUNK) < recipe.steps
    return carry, jnp.sum(losses * inside) / jnp.maximum(jnp.sum(inside), 1)


def fit(
    u_in: Floats,
    u_out: Floats,
    dt: Floats,
    pressure: Floats,
    *,
    architecture: Architecture | None = None,
    recipe: Recipe | None = None,
    seed: int = 0,
    weight: Floats | None = None,
    tau: float | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Learned:
    """Train a learned plant on recorded breaths.

    Bit-reproducible on one machine: every random number comes from ``seed`` and the number of
    the update, so that an interrupted training continues as if it had not been. Mind the leak
    told in :class:`~ventbench.plants.learned.Learned`.

    Args:
        u_in: inspiratory valve, %, shape ``(n, T)``.
        u_out: expiratory valve, 0/1, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``.
        pressure: cmH2O, shape ``(n, T)``, NaN where blank.
        architecture: of the network.
        recipe: of the training.
        seed: of the weights, the batches and the noise; one a member of an ensemble.
        weight: of each breath, shape ``(n,)``.
        tau: time constant of expiration, s; fitted to the expirations if not given.
        checkpoint: file that the training is saved to every ``CHUNK`` updates and resumed from;
            deleted at the end.
        progress: called after every ``CHUNK`` updates.

    Returns:
        The trained plant, float32.

    Raises:
        ValueError: if the data cannot be trained on (see :func:`inspirations`), or the checkpoint
            belongs to another training (an ``InputError``).
        FloatingPointError: if the loss is not finite; the checkpoint stays at the last good one.
    """
    architecture, recipe = architecture or Architecture(), recipe or Recipe()
    data = inspirations(u_in, u_out, dt, pressure, architecture.pressures, weight)
    if tau is None:
        tau = expiratory_time_constant(u_out, dt, pressure)
    init_key, train_key = jax.random.split(jax.random.key(seed))
    plant = learned(init_key, architecture, normalisation(data, tau))
    nets: Any = (plant.general, plant.boundary)
    carry: Any = (nets, _optimiser(recipe).init(nets))
    settings = {
        "architecture": dataclasses.asdict(architecture), "recipe": dataclasses.asdict(recipe),
        "seed": seed, "tau": tau, "data": fingerprint(data),
    }  # fmt: skip
    stored = Checkpoint(checkpoint, settings)
    carry, first = stored.restore(carry)
    while first < recipe.steps:
        new, loss = _advance(carry, plant, data, train_key, jnp.asarray(first), recipe)
        loss = float(loss)
        if not np.isfinite(loss):
            raise FloatingPointError(
                f"training diverged between updates {first} and {first + CHUNK}"
            )
        carry, first = new, min(first + CHUNK, recipe.steps)
        stored.save(carry, first)
        if progress is not None:
            progress(Progress(first, recipe.steps, loss))
    stored.delete()
    (general, boundary), _ = carry
    return dataclasses.replace(plant, general=general, boundary=boundary)
