"""Second stage of a fit: the expiratory valve, from whole measured breaths.

The inspirations have fixed everything else. Whole breaths now tell the conductance and the opening
delay of the expiratory valve; all other parameters stay.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from ventbench.plants.sessions import Sessions
from ventbench.recordings.breaths import Breaths
from ventbench.rollouts import open_loop
from ventbench.training.hybrid.data import groups_of
from ventbench.training.hybrid.fit import Recipe
from ventbench.training.hybrid.parameters import Groups, Pooled, plants

#: What this stage changes, and how far each is believed to move, the deviation of its logarithm.
WIDTHS = {"conductance": 1.0, "session_conductance": 0.3, "opening_delay": 0.7}

ITERATIONS, LEARNING_RATE = 80, 0.05


@flax.struct.dataclass
class WholeBreaths:
    """n measured breaths of T samples, float64; pressure 0 where none is known.

    Attributes:
        groups: setting, kind of rig and session.
        pressure: cmH2O, shape ``(n, T)``.
        u_in: %, likewise.
        u_out: 0/1, likewise.
        dt: s, likewise.
        share: weight of each sample in its breath's error, likewise: the inspiration adds up to
            one, and so does the expiration; all 0 for a breath that cannot be used.
    """

    groups: Groups
    pressure: Array
    u_in: Array
    u_out: Array
    dt: Array
    share: Array


def whole_breaths(breaths: Breaths, sessions: Sessions) -> WholeBreaths:
    """Arrange whole breaths; one without a first pressure or an expiration counts for nothing."""
    known = breaths.valid & np.isfinite(breaths.pressure)
    opened = known & (breaths.u_out == 1)
    usable = known[:, :1] & opened.any(axis=1, keepdims=True)
    share = np.zeros(known.shape)
    for part in (opened, known & (breaths.u_out == 0)):
        share += usable * part / np.maximum(part.sum(axis=1, keepdims=True), 1)
    arrays = (np.nan_to_num(breaths.pressure), breaths.u_in, breaths.u_out, breaths.dt, share)
    return WholeBreaths(groups_of(breaths, sessions), *(jnp.asarray(x, float) for x in arrays))


@partial(jax.jit, static_argnames="recipe")
def fit_expiration(pooled: Pooled, data: WholeBreaths, weight: Array, recipe: Recipe) -> Pooled:
    """Fit the expiratory valve; call it within :func:`ventbench.precision.float64`.

    Args:
        pooled: from :func:`ventbench.training.hybrid.fit.fit`.
        data: from :func:`whole_breaths`.
        weight: of each breath, shape ``(n,)``; 0 leaves it out.
        recipe: as of the first stage.

    Returns:
        The parameters with those of :data:`WIDTHS` moved.
    """
    start = {name: getattr(pooled, name) for name in WIDTHS}
    optimiser = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, ITERATIONS, 0.01))
    soft, saturation = recipe.softness, recipe.saturation

    def loss(moved: dict[str, Array]) -> Array:
        plant = plants(replace(pooled, **moved), data.groups, directed=recipe.directed)
        found = open_loop(plant, data.pressure[:, 0], data.u_in, data.u_out, data.dt)
        error = jnp.where(data.share > 0, found - data.pressure, 0.0)
        breath = jnp.sum(data.share * (jnp.sqrt(error**2 + soft**2) - soft), axis=1)
        breath = saturation * jnp.log1p(breath / saturation)
        moves = [jnp.sum(((moved[name] - start[name]) / WIDTHS[name]) ** 2) for name in WIDTHS]
        prior = 0.5 * recipe.prior * sum(moves)
        return (jnp.sum(weight * breath) + prior) / jnp.maximum(jnp.sum(weight), 1.0)

    def iterate(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        moved, state = carry
        updates, state = optimiser.update(jax.grad(loss)(moved), state)
        return (optax.apply_updates(moved, updates), state), None

    (moved, _), _ = jax.lax.scan(iterate, (start, optimiser.init(start)), None, length=ITERATIONS)
    return replace(pooled, **moved)
