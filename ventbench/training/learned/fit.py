"""Training of the learned plant: one-step loss first, then open-loop runs of growing length."""

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

from ventbench.plants.learned import Architecture, Learned, LearnedState, learned
from ventbench.resume import Checkpoint, fingerprint
from ventbench.training.learned.data import (
    Floats,
    WindowedInspirations,
    expiratory_time_constant,
    inspirations,
    normalisation,
)


@dataclasses.dataclass(frozen=True)
class LearnedConfig:
    """Settings of the training of a learned plant.

    Attributes:
        steps: updates; the schedules stretch over them.
        batch: breaths an update, drawn with replacement.
        learning_rate: peak of the cosine schedule.
        weight_decay: weight decay of AdamW.
        one_step: share of the updates with one-step loss.
        whole: share of the updates, at the end, with open-loop runs over the whole inspiration;
            between the two the horizon grows geometrically.
        softness: error below which the loss turns from absolute to square, cmH2O.
        noise: standard deviation added to measured windows, cmH2O. The sensor's own 0.2 lowered the
            error on recordings by 4 % but made other intervals four times worse on synthetic
            breaths: the network then trusts the commands, which do not tell the time.
        rising: weight of the penalty on steps at which pressure falls as the valve opens; 0 for
            the paper's training, see :func:`~ventbench.plants.sensitivity.control_sensitivity`.
    """

    steps: int = 1500
    batch: int = 32
    learning_rate: float = 3e-3
    weight_decay: float = 1e-3
    one_step: float = 0.2
    whole: float = 0.4
    softness: float = 0.2
    noise: float = 0.0
    rising: float = 0.0

    def __post_init__(self) -> None:
        """Refuse numbers that cannot work.

        Raises:
            ValueError: naming the field and its value.
        """
        for name in ("steps", "batch", "learning_rate", "softness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must be positive")
        for name in ("weight_decay", "noise", "rising", "one_step", "whole"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must not be negative")
        if self.one_step + self.whole > 1:
            raise ValueError(
                f"training: one_step + whole = {self.one_step + self.whole} must not exceed 1"
            )


def horizon(config: LearnedConfig, done: Array, steps: int) -> Array:
    """Open-loop steps between two measured windows, growing from 1 to the whole inspiration."""
    growth = max(1.0 - config.one_step - config.whole, 1e-6)
    share = jnp.clip((done - config.one_step) / growth, 0.0, 1.0)
    return jnp.where(share >= 1.0, steps + 1, jnp.floor(steps**share)).astype(jnp.int32)


def open_loop_loss(
    nets: tuple[Any, Any],
    plant: Learned,
    batch: WindowedInspirations,
    measured: Array,
    noise: Array,
    config: LearnedConfig,
) -> Array:
    """Soft absolute error of the next pressures, cmH2O.

    Args:
        nets: the trained parts, ``(general, boundary)``.
        plant: the rest of the plant.
        batch: breaths.
        measured: True where a run starts anew from the measured window, shape ``(n, T)``.
        noise: noise that is added to measured windows, cmH2O, shape of ``batch.window``.
        config: softness and penalty.
    """
    plant = dataclasses.replace(plant, general=nets[0], boundary=nets[1])
    closed = jnp.zeros_like(batch.start)

    def step(state: LearnedState, now: tuple[Array, ...]) -> tuple[LearnedState, Any]:
        u_in, dt, window, take = now
        # What was not measured is what the run itself predicted.
        state = dataclasses.replace(state, pressures=jnp.where(take, window, state.pressures))
        if config.rising == 0:
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
    error = (pressure.T - batch.after) / config.softness
    cost = config.softness * (jnp.sqrt(1.0 + error**2) - 1.0)
    # Slopes in units of the whole valve: cmH2O per 100 %.
    cost = cost + config.rising * 100.0 * jnp.maximum(-slope.T, 0.0)
    return jnp.sum(batch.weight * cost) / jnp.maximum(jnp.sum(batch.weight), 1.0)


#: Called with the number of updates done, the number of all updates, and the mean loss since the
#: last call, cmH2O.
Progress = Callable[[int, int, float], None]

#: Updates compiled into one scan; a checkpoint or a Ctrl-C falls between two of them.
CHUNK = 50


def _optimiser(config: LearnedConfig) -> optax.GradientTransformation:
    warm = max(config.steps // 50, 1)
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, config.learning_rate, warm, max(config.steps, warm + 1)
    )
    return optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=config.weight_decay)
    )


@partial(jax.jit, static_argnames="config")
def _advance(
    carry: tuple[Any, Any],
    plant: Learned,
    data: WindowedInspirations,
    key: Array,
    first: Array,
    config: LearnedConfig,
) -> tuple[tuple[Any, Any], Array]:
    """``CHUNK`` updates, fewer at the end; returns the nets, the optimiser's state, mean loss."""
    optimiser = _optimiser(config)
    length = data.u_in.shape[1]

    def update(carry: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        nets, state = carry
        draw_key, phase_key, noise_key = jax.random.split(jax.random.fold_in(key, number), 3)
        rows = jax.random.randint(draw_key, (config.batch,), 0, data.count)
        batch = jax.tree.map(lambda x: x[rows] if x.ndim else x, data)
        reach = horizon(config, number / config.steps, length)
        phase = jax.random.randint(phase_key, (config.batch, 1), 0, reach)
        # A run over the whole inspiration takes no measured window but the start.
        measured = ((jnp.arange(length) + phase) % reach == 0) & (reach <= length)
        noise = config.noise * jax.random.normal(noise_key, batch.window.shape)
        loss, gradient = jax.value_and_grad(open_loop_loss)(
            nets, plant, batch, measured, noise, config
        )
        updates, state = optimiser.update(gradient, state, nets)
        new = (optax.apply_updates(nets, updates), state)
        last = number >= config.steps
        return jax.tree.map(lambda a, b: jnp.where(last, a, b), (nets, carry[1]), new), loss

    carry, losses = jax.lax.scan(update, carry, first + jnp.arange(CHUNK))
    inside = first + jnp.arange(CHUNK) < config.steps
    return carry, jnp.sum(losses * inside) / jnp.maximum(jnp.sum(inside), 1)


def fit(
    u_in: Floats,
    u_out: Floats,
    dt: Floats,
    pressure: Floats,
    *,
    architecture: Architecture | None = None,
    config: LearnedConfig | None = None,
    seed: int = 0,
    weight: Floats | None = None,
    tau: float | None = None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> Learned:
    """Train a learned plant on recorded breaths.

    Bit-reproducible on one machine: every random number comes from ``seed`` and the number of
    the update, so that an interrupted training continues as if it had not been. Mind the leak
    described in :class:`~ventbench.plants.learned.Learned`.

    Args:
        u_in: inspiratory valve, %, shape ``(n, T)``.
        u_out: expiratory valve, 0/1, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``.
        pressure: cmH2O, shape ``(n, T)``, NaN where blank.
        architecture: sizes of the network.
        config: settings of the training.
        seed: seed of weights, batches and noise; each member of an ensemble has its own.
        weight: weight of each breath, shape ``(n,)``.
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
    architecture, config = architecture or Architecture(), config or LearnedConfig()
    data = inspirations(u_in, u_out, dt, pressure, architecture.pressures, weight)
    if tau is None:
        tau = expiratory_time_constant(u_out, dt, pressure)
    init_key, train_key = jax.random.split(jax.random.key(seed))
    plant = learned(init_key, architecture, normalisation(data, tau))
    nets: Any = (plant.general, plant.boundary)
    carry: Any = (nets, _optimiser(config).init(nets))
    settings = {
        "architecture": dataclasses.asdict(architecture), "config": dataclasses.asdict(config),
        "seed": seed, "tau": tau, "data": fingerprint(data),
    }  # fmt: skip
    stored = Checkpoint(checkpoint, settings)
    carry, first = stored.restore(carry)
    while first < config.steps:
        new, loss = _advance(carry, plant, data, train_key, jnp.asarray(first), config)
        loss = float(loss)
        if not np.isfinite(loss):
            raise FloatingPointError(
                f"training diverged between updates {first} and {first + CHUNK}"
            )
        carry, first = new, min(first + CHUNK, config.steps)
        stored.save(carry, first)
        if progress is not None:
            progress(first, config.steps, loss)
    stored.delete()
    (general, boundary), _ = carry
    return dataclasses.replace(plant, general=general, boundary=boundary)
