"""Training of the residual controller: gradients through simulators, Adam, one compiled scan."""

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

from ventbench import protocol
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import Residual, untrained
from ventbench.interfaces import Plant
from ventbench.resume import Checkpoint, fingerprint
from ventbench.training.residual.loss import disagreement
from ventbench.training.residual.loss import loss as objective
from ventbench.training.residual.randomise import scenarios
from ventbench.training.residual.recipe import Progress, Recipe

#: Updates compiled into one scan; a checkpoint or a Ctrl-C falls between two of them.
CHUNK = 50


def _optimiser(recipe: Recipe) -> optax.GradientTransformation:
    warm = max(recipe.updates // 50, 1)
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, recipe.learning_rate, warm, max(recipe.updates, warm + 1)
    )
    return optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=recipe.weight_decay)
    )


def _cells(number: Array, lungs: int, pips: int, recipe: Recipe) -> tuple[Array, Array]:
    """Lung and PIP of each run of an update."""
    if recipe.round_robin:
        cell = jnp.full(recipe.copies, number % (lungs * pips))
    else:
        cell = jnp.repeat(jnp.arange(lungs * pips), recipe.copies)
    return cell // pips, cell % pips


@partial(jax.jit, static_argnames="recipe")
def _advance(
    carry: tuple[Any, Any],
    controller: Residual,
    plants: Plant,
    key: Array,
    first: Array,
    recipe: Recipe,
) -> tuple[tuple[Any, Any], Array]:
    """``CHUNK`` updates, fewer at the end; returns layers, the optimiser's state and mean loss."""
    optimiser = _optimiser(recipe)
    members, lungs = jax.tree.leaves(plants)[0].shape[:2]
    pips = jnp.asarray(protocol.PIPS, jnp.float32)

    def update(carry: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        layers, state = carry
        member_key, bench_key = jax.random.split(jax.random.fold_in(key, number))
        lung, pip = _cells(number, lungs, len(protocol.PIPS), recipe)
        nominal = jnp.arange(lung.size) % recipe.copies == 0
        member = jax.random.randint(member_key, lung.shape, 0, members) * ~nominal
        cells = scenarios(bench_key, pips[pip], nominal, recipe.spread)
        those = jax.tree.map(lambda leaf: leaf[member, lung], plants)

        def value(layers: Any) -> Array:
            corrected = controller.replace(layers=layers)  # type: ignore[attr-defined]
            error, u_in = objective(corrected, those, cells, recipe.first_breath, recipe.lam)
            if recipe.agreement == 0 or members == 1:
                return error
            some = slice(None, None, recipe.copies)  # the official runs
            every = jax.tree.map(lambda leaf: leaf[:, lung[some]], plants)
            cell = jax.tree.map(lambda x: x[some], cells)
            apart = disagreement(every, cell, u_in[some, protocol.SCORED_BREATHS[0]])
            return error + recipe.agreement * apart

        loss, gradient = jax.value_and_grad(value)(layers)
        updates, state = optimiser.update(gradient, state, layers)
        new = (optax.apply_updates(layers, updates), state)
        last = number >= recipe.updates
        return jax.tree.map(lambda a, b: jnp.where(last, a, b), carry, new), loss

    carry, losses = jax.lax.scan(update, carry, first + jnp.arange(CHUNK))
    inside = first + jnp.arange(CHUNK) < recipe.updates
    return carry, jnp.sum(losses * inside) / jnp.maximum(jnp.sum(inside), 1)


def fit(
    plants: Plant,
    gains: tuple[float, float, float],
    *,
    recipe: Recipe | None = None,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    keep: bool = False,
) -> Residual:
    """Train the correction of a PID on one lung, or on several at once.

    Bit-reproducible on one machine: every random number comes from ``seed`` and the number of
    the update, so that an interrupted training continues as if it had not been.

    Args:
        plants: simulators, leaves ``(members, lungs, ...)``; members beyond the recipe's are left
            out.
        gains: P, I, D of the PID, %/cmH2O; they stay.
        recipe: of the training.
        seed: of the weights and the benches.
        checkpoint: file that the training is saved to every ``CHUNK`` updates and resumed from;
            deleted at the end.
        progress: called after every ``CHUNK`` updates.
        keep: leave the checkpoint, so that a finished training is read from it.

    Returns:
        The controller, float32.

    Raises:
        InputError: if the checkpoint belongs to another training.
        FloatingPointError: if the loss is not finite; the checkpoint stays at the last good one.
    """
    recipe = recipe or Recipe()
    plants = jax.tree.map(lambda leaf: jnp.asarray(leaf[: recipe.members], jnp.float32), plants)
    start_key, key = jax.random.split(jax.random.key(seed))
    like = Residual(
        PID(*(jnp.asarray(gain, jnp.float32) for gain in gains)),
        (),
        pressures=recipe.pressures,
        commands=recipe.commands,
        ahead=recipe.ahead,
        limit=recipe.limit,
    )
    controller = untrained(start_key, like, recipe.widths)
    carry: Any = (controller.layers, _optimiser(recipe).init(controller.layers))
    settings = {
        "recipe": dataclasses.asdict(recipe), "gains": list(gains), "seed": seed,
        "simulators": fingerprint(plants),
    }  # fmt: skip
    stored = Checkpoint(checkpoint, settings)
    carry, first = stored.restore(carry)
    while first < recipe.updates:
        new, loss = _advance(carry, like, plants, key, jnp.asarray(first), recipe)
        loss = float(loss)
        if not np.isfinite(loss):
            raise FloatingPointError(
                f"training diverged between updates {first} and {first + CHUNK}"
            )
        carry, first = new, min(first + CHUNK, recipe.updates)
        stored.save(carry, first)
        if progress is not None:
            progress(Progress(first, recipe.updates, loss))
    if not keep:
        stored.delete()
    return controller.replace(layers=carry[0])  # type: ignore[attr-defined]
