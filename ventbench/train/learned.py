"""Training of the learned plant: one-step loss first, then open-loop runs of growing length."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from numpy.typing import NDArray

from ventbench.base.resume import Checkpoint, fingerprint
from ventbench.plants.learned import (
    REFERENCE_DT,
    Architecture,
    Learned,
    LearnedState,
    Normalisation,
    learned,
)
from ventbench.train.residual import FitProgress, chunk, optimiser, run_chunks

Floats = NDArray[np.floating]

#: Breaths and steps are padded to multiples of these, so that all lungs share one compilation.
_PAD_BREATHS, _PAD_STEPS = 128, 32


@flax.struct.dataclass
class WindowedInspirations:
    """Training data: inspirations, step by step, padded; every array float32."""

    start: Array  #: first pressure, cmH2O, shape ``(n,)``.
    u_in: Array  #: command of each step, %, shape ``(n, T)``.
    dt: Array  #: time for which it was held, s, shape ``(n, T)``.
    after: Array  #: pressure at its end, cmH2O, 0 where unknown, shape ``(n, T)``.
    weight: Array  #: weight of the pressure in the loss, 0 where unknown, shape ``(n, T)``.
    window: Array  #: measured pressures up to each step, the newest last, cmH2O, ``(n, T, H_p)``.
    known: Array  #: whether each pressure of the window was measured, shape ``(n, T, H_p)``.
    count: Array  #: breaths before the padding, shape ``()``.


def inspirations(
    u_in: Floats,
    u_out: Floats,
    dt: Floats,
    pressure: Floats,
    window: int,
    weight: Floats | None = None,
) -> WindowedInspirations:
    """Arrange recorded breaths for training.

    Args:
        u_in: inspiratory valve, %, shape ``(n, T)``.
        u_out: expiratory valve, 0/1, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``; the last one is not used.
        pressure: cmH2O, shape ``(n, T)``, NaN where blank. A blank first pressure takes the next
            one known, for the start alone.
        window: length of the pressure window.
        weight: weight of each breath in the loss, shape ``(n,)``; 1 if not given.

    Raises:
        ValueError: if shapes differ, there is no breath, a breath has no inspiration or no pressure
            to learn from, or a command or interval of an inspiration is not finite or possible.
    """
    u_in, u_out, dt, pressure = (np.asarray(x, float) for x in (u_in, u_out, dt, pressure))
    if not (u_in.ndim == 2 and u_in.shape == u_out.shape == dt.shape == pressure.shape):
        raise ValueError(
            f"training arrays must share one shape (n, T); got u_in {u_in.shape}, u_out "
            f"{u_out.shape}, dt {dt.shape}, pressure {pressure.shape}"
        )
    n, samples = u_in.shape
    if n == 0 or samples < 2:
        raise ValueError(f"training needs breaths of two samples or more; got shape {u_in.shape}")
    breath_weight = np.ones(n) if weight is None else np.asarray(weight, float)
    if breath_weight.shape != (n,) or not np.all(breath_weight >= 0):
        raise ValueError("weight must hold one number >= 0 for each breath")
    # Steps until the expiratory valve first opens.
    active = np.cumprod(u_out < 0.5, axis=1)[:, :-1] > 0
    for name, array, low, high in (("u_in", u_in, 0.0, 100.0), ("dt", dt, 1e-4, 1.0)):
        bad = active & ~((array[:, :-1] >= low) & (array[:, :-1] <= high))
        if bad.any():
            i, j = np.argwhere(bad)[0]
            raise ValueError(
                f"breath {i}, step {j}: {name} = {array[i, j]} is outside {low:g}..{high:g}"
            )
    known = np.isfinite(pressure)
    learnable = active & known[:, 1:]
    if not learnable.any(axis=1).all():
        i = int(np.flatnonzero(~learnable.any(axis=1))[0])
        raise ValueError(f"breath {i} has no inspiratory step with a known pressure after it")
    start = pressure[np.arange(n), np.argmax(known, axis=1)]

    steps = int(active.sum(axis=1).max())
    steps = -(-steps // _PAD_STEPS) * _PAD_STEPS
    rows = -(-n // _PAD_BREATHS) * _PAD_BREATHS

    def pad(values: NDArray[Any]) -> NDArray[Any]:
        values = values[:, :steps]
        return np.pad(values, ((0, rows - n), (0, steps - values.shape[1])))

    # Before the first sample the windows hold the start, as a lung at rest does.
    past = np.concatenate([np.repeat(start[:, None], window, axis=1), pressure[:, 1:-1]], axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(past, window, axis=1)
    fields = {
        "start": np.pad(start, (0, rows - n)),
        "u_in": pad(np.where(active, u_in[:, :-1], 0.0)),
        "dt": np.where(pad(active), pad(dt[:, :-1]), REFERENCE_DT),
        "after": pad(np.where(learnable, pressure[:, 1:], 0.0)),
        "weight": pad(learnable * breath_weight[:, None]),
        "window": np.stack([pad(np.nan_to_num(windows[..., k])) for k in range(window)], axis=-1),
        "known": np.stack([pad(np.isfinite(windows[..., k])) for k in range(window)], axis=-1),
    }
    arrays = {
        name: jnp.asarray(x, bool if x.dtype == bool else jnp.float32) for name, x in fields.items()
    }
    return WindowedInspirations(**arrays, count=jnp.asarray(n, jnp.int32))


def normalisation(data: WindowedInspirations, tau: float) -> Normalisation:
    """Constants for the inputs and outputs of a network from what it will be trained on.

    Args:
        data: the training set.
        tau: time constant of expiration, s.
    """
    used = np.asarray(data.weight) > 0
    pressure, u_in = np.asarray(data.after)[used], np.asarray(data.u_in)[used]
    now = np.asarray(data.window)[..., -1][used]
    both = np.asarray(data.known)[..., -1][used]
    change = float(np.std((pressure - now)[both])) if both.any() else 1.0
    return Normalisation(
        pressure_mean=float(pressure.mean()),
        pressure_scale=max(float(pressure.std()), 1.0),
        control_mean=float(u_in.mean()),
        control_scale=max(float(u_in.std()), 1.0),
        jump_scale=max(change, 0.1),
        rate_scale=max(change, 0.1),
        tau=tau,
    )


def expiratory_time_constant(u_out: Floats, dt: Floats, pressure: Floats) -> float:
    """Fit the time constant of expiration, s, by least absolute error.

    Each expiration relaxes from its first pressure to a rest pressure of its own.

    Args:
        u_out: expiratory valve, 0/1, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``.
        pressure: cmH2O, shape ``(n, T)``, NaN where blank; breaths with blanks are left out.

    Returns:
        A value in 0.02..2 s; 0.2 s if no expiration was measured.
    """
    taus = np.geomspace(0.02, 2.0, 100)
    error = np.zeros_like(taus)
    measured = False
    for valve, interval, p in zip(u_out, dt, pressure, strict=True):
        opened = np.flatnonzero(np.asarray(valve) > 0.5)
        if opened.size < 20 or not np.all(np.isfinite(p[opened[0] :])):
            continue
        first = opened[0]
        time = np.concatenate([[0.0], np.cumsum(interval[first:-1])])
        decay = np.exp(-time[:, None] / taus)
        p = np.asarray(p, float)[first:, None]
        excess = p - p[0] * decay  # = rest (1 - decay): its least squares is the rest pressure
        rest = (excess * (1 - decay)).sum(axis=0) / ((1 - decay) ** 2).sum(axis=0)
        error += np.abs(rest + (p[0] - rest) * decay - p).sum(axis=0)
        measured = True
    return float(taus[np.argmin(error)]) if measured else 0.2


@dataclasses.dataclass(frozen=True)
class LearnedConfig:
    """Settings of the training of a learned plant."""

    steps: int = 1500  #: updates; the schedules stretch over them.
    batch: int = 32  #: breaths an update, drawn with replacement.
    learning_rate: float = 3e-3  #: peak of the cosine schedule.
    weight_decay: float = 1e-3  #: weight decay of AdamW.
    one_step: float = 0.2  #: share of the updates with one-step loss.
    #: share of the updates, at the end, with open-loop runs over the whole inspiration; between the
    #: two the horizon grows geometrically.
    whole: float = 0.4
    softness: float = 0.2  #: error below which the loss turns from absolute to square, cmH2O.

    def __post_init__(self) -> None:
        """Refuse numbers that cannot work.

        Raises:
            ValueError: naming the field and its value.
        """
        for name in ("steps", "batch", "learning_rate", "softness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must be positive")
        for name in ("weight_decay", "one_step", "whole"):
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
    config: LearnedConfig,
) -> Array:
    """Soft absolute error of the next pressures, cmH2O, with the nets ``(general, boundary)``.

    A run starts anew from the measured window where ``measured`` is true, shape ``(n, T)``.
    """
    plant = dataclasses.replace(plant, general=nets[0], boundary=nets[1])
    closed = jnp.zeros_like(batch.start)

    def step(state: LearnedState, now: tuple[Array, ...]) -> tuple[LearnedState, Array]:
        u_in, dt, window, take = now
        # What was not measured is what the run itself predicted.
        state = dataclasses.replace(state, pressures=jnp.where(take, window, state.pressures))
        state, signals = plant.step(state, u_in, closed, dt)
        return state, signals.reading

    take = batch.known & measured[..., None]
    steps = (batch.u_in, batch.dt, batch.window, take)
    _, pressure = jax.lax.scan(
        step, plant.init(batch.start)[0], jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), steps)
    )
    error = (pressure.T - batch.after) / config.softness
    cost = config.softness * (jnp.sqrt(1.0 + error**2) - 1.0)
    return jnp.sum(batch.weight * cost) / jnp.maximum(jnp.sum(batch.weight), 1.0)


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
    adam = optimiser(config.steps, config.learning_rate, config.weight_decay)
    length = data.u_in.shape[1]

    def update(carry: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        nets, state = carry
        draw_key, phase_key, _ = jax.random.split(jax.random.fold_in(key, number), 3)
        rows = jax.random.randint(draw_key, (config.batch,), 0, data.count)
        batch = jax.tree.map(lambda x: x[rows] if x.ndim else x, data)
        reach = horizon(config, number / config.steps, length)
        phase = jax.random.randint(phase_key, (config.batch, 1), 0, reach)
        # A run over the whole inspiration takes no measured window but the start.
        measured = ((jnp.arange(length) + phase) % reach == 0) & (reach <= length)
        loss, gradient = jax.value_and_grad(open_loop_loss)(nets, plant, batch, measured, config)
        updates, state = adam.update(gradient, state, nets)
        return (optax.apply_updates(nets, updates), state), loss

    return chunk(update, carry, first, config.steps)


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
    checkpoint: Path | None = None,
    progress: FitProgress | None = None,
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
        seed: seed of weights and batches; each member of an ensemble has its own.
        weight: weight of each breath, shape ``(n,)``.
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
    tau = expiratory_time_constant(u_out, dt, pressure)
    init_key, train_key = jax.random.split(jax.random.key(seed))
    plant = learned(init_key, architecture, normalisation(data, tau))
    nets: Any = (plant.general, plant.boundary)
    adam = optimiser(config.steps, config.learning_rate, config.weight_decay)
    carry: Any = (nets, adam.init(nets))
    settings = {
        "architecture": dataclasses.asdict(architecture), "config": dataclasses.asdict(config),
        "seed": seed, "tau": tau, "data": fingerprint(data),
    }  # fmt: skip
    stored = Checkpoint(checkpoint, settings)
    (general, boundary), _ = run_chunks(
        lambda carry, first: _advance(carry, plant, data, train_key, first, config),
        carry, config.steps, stored, progress,
    )  # fmt: skip
    stored.delete()
    return dataclasses.replace(plant, general=general, boundary=boundary)
