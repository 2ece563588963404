"""The paper's stitched network: from windows of past pressures and commands to the next pressure.

It learns inspirations, as the paper's does (section 4.3 and appendix B; authors' code for the
boundary networks). From both windows, the command now included, a network gives a *jump* and a
*rate*; the next pressure is ``p + change_scale (jump (u - u_before) / control_scale + rate dt /
REFERENCE_DT)``. For an R-C lung the jump is R times the step of flow, whatever dt, and the rate
is flow / C, so that a network is right at any interval. The interval is no input, since in the
recordings it betrays the rig. The first N_B steps use a network each. Where commands come from a
feedback law, the command now tells the pressure now, and a network, the paper's too, can learn to
read it there: its open-loop error is then better than its physics.

Training starts with one-step predictions and ends with open-loop runs over whole inspirations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from submissions.residual_mlp.train import optimiser
from ventbench.base.arrays import Floats
from ventbench.controllers.residual import Layer, apply
from ventbench.recordings import Breaths

#: Interval at which the network's rate output is an increment, s (mean of the recordings').
REFERENCE_DT = 0.033

#: Breaths and steps are padded to multiples of these, so that all lungs share one compilation.
_PAD_BREATHS, _PAD_STEPS = 128, 32

Layers = tuple[Layer, ...]


@dataclass(frozen=True)
class Architecture:
    """Shape of a stitched network; the defaults are the paper's for R5C10."""

    pressures: int = 5  #: length of the pressure window, H_p.
    controls: int = 10  #: length of the control window, H_c; the command now is its last entry.
    width: int = 150  #: number of units of each hidden layer.
    depth: int = 9  #: number of matrices, the output's included (the authors' count).
    boundaries: int = 1  #: N_B, one-hidden-layer networks for the first steps of an inspiration.
    boundary_width: int = 100  #: hidden width of the boundary networks (authors' code: 100).


@dataclass(frozen=True)
class Training:
    """Settings of a training; hashable, as they are static in ``jit``."""

    steps: int = 1500  #: updates; the schedules stretch over them.
    batch: int = 32  #: breaths an update, drawn with replacement.
    learning_rate: float = 3e-3  #: peak of the cosine schedule.
    weight_decay: float = 1e-3  #: weight decay of AdamW.
    one_step: float = 0.2  #: share of the updates with one-step loss.
    #: share of the updates, at the end, with open-loop runs over the whole inspiration; between the
    #: two the horizon grows geometrically.
    whole: float = 0.4
    softness: float = 0.2  #: error below which the loss turns from absolute to square, cmH2O.


class Inspirations(NamedTuple):
    """Inspirations, step by step, padded; every array float32."""

    start: Array  #: first pressure, cmH2O, shape ``(n,)``.
    u_in: Array  #: command of each step, %, shape ``(n, T)``.
    dt: Array  #: time for which it was held, s, shape ``(n, T)``.
    after: Array  #: pressure at its end, cmH2O, 0 where unknown, shape ``(n, T)``.
    weight: Array  #: weight of the pressure in the loss, 0 where unknown, shape ``(n, T)``.
    window: Array  #: measured pressures up to each step, the newest last, cmH2O, ``(n, T, H_p)``.
    known: Array  #: whether each pressure of the window was measured, bool, ``(n, T, H_p)``.


class Scales(NamedTuple):
    """Constants by which a network's inputs and outputs are normalised."""

    pressure_mean: Any  #: cmH2O.
    pressure_scale: Any  #: cmH2O.
    control_mean: Any  #: %.
    control_scale: Any  #: %.
    #: cmH2O for a unit jump output at a command step of ``control_scale``, and in ``REFERENCE_DT``
    #: for a unit rate output.
    change_scale: Any


@flax.struct.dataclass
class Network:
    """A stitched network."""

    general: Layers  #: after the boundary steps.
    boundary: Layers  #: of the first steps, every leaf ``(N_B, ...)``; empty if there are none.
    scales: Scales
    windows: tuple[int, int] = flax.struct.field(pytree_node=False)  #: ``(H_p, H_c)``.

    def run(self, start: Array, u_in: Array, dt: Array, window: Array, known: Array) -> Array:
        """Pressure after each step, cmH2O, shape ``(n, T)``.

        Before the first step the windows hold the first pressure and command 0.

        Args:
            start: first pressure, cmH2O, shape ``(n,)``.
            u_in: command of each step, %, shape ``(n, T)``.
            dt: time for which it is held, s, shape ``(n, T)``.
            window: measured pressures up to each step, cmH2O, shape ``(n, T, H_p)``.
            known: where they replace the run's own, bool, shape ``(n, T, H_p)``.
        """
        scales = self.scales

        def step(carry: tuple[Array, Array], now: tuple[Array, ...]) -> tuple[Any, Array]:
            pressures, controls = carry
            index, u_in, dt, measured, take = now
            pressures = jnp.where(take, measured, pressures)
            change = (u_in - controls[:, -1]) / scales.control_scale
            controls = jnp.concatenate([controls[:, 1:], u_in[:, None]], axis=1)
            features = [
                (pressures - scales.pressure_mean) / scales.pressure_scale,
                (controls - scales.control_mean) / scales.control_scale,
            ]
            jump, rate = self._outputs(jnp.concatenate(features, axis=1), index).T
            rise = scales.change_scale * (jump * change + rate * dt / REFERENCE_DT)
            after = pressures[:, -1] + rise
            pressures = jnp.concatenate([pressures[:, 1:], after[:, None]], axis=1)
            return (pressures, controls), after

        pressures = jnp.repeat(start[:, None], self.windows[0], axis=1)
        begin = pressures, jnp.zeros((len(start), self.windows[1]), start.dtype)
        steps = (jnp.moveaxis(x, 1, 0) for x in (u_in, dt, window, known))
        return jax.lax.scan(step, begin, (jnp.arange(u_in.shape[1]), *steps))[1].T

    def _outputs(self, features: Array, index: Array) -> Array:
        out = apply(self.general, features)
        if not self.boundary:
            return out
        count = len(self.boundary[0][1])
        first = jax.tree.map(lambda leaf: leaf[jnp.minimum(index, count - 1)], self.boundary)
        return jnp.where(index < count, apply(first, features), out)


def untrained(key: Array, shape: Architecture, scales: Scales) -> Network:
    """Draw a network in float32."""
    inputs = shape.pressures + shape.controls
    general_key, boundary_key = jax.random.split(key)
    general = _layers(general_key, (inputs, *([shape.width] * (shape.depth - 1)), 2))
    boundary: Layers = ()
    if shape.boundaries:
        keys = jax.random.split(boundary_key, shape.boundaries)
        boundary = jax.vmap(lambda key: _layers(key, (inputs, shape.boundary_width, 2)))(keys)
    as_float32 = Scales(*(jnp.asarray(value, jnp.float32) for value in scales))
    return Network(general, boundary, as_float32, (shape.pressures, shape.controls))


def _layers(key: Array, sizes: tuple[int, ...]) -> Layers:
    """Draw LeCun-normal weights of layers, those of the output scaled by 0.1, and zero biases."""
    factors = [n**-0.5 for n in sizes[:-1]]
    factors[-1] *= 0.1
    keys = jax.random.split(key, len(factors))
    return tuple(
        (factor * jax.random.normal(key, (n, m), jnp.float32), jnp.zeros(m, jnp.float32))
        for factor, key, n, m in zip(factors, keys, sizes[:-1], sizes[1:], strict=True)
    )


def inspirations(breaths: Breaths, weight: Floats, window: int) -> Inspirations:
    """Arrange recorded breaths for training.

    Args:
        breaths: n recorded breaths. A blank first pressure takes the next one known, for the start
            alone.
        weight: weight of each breath in the loss, shape ``(n,)``.
        window: length of the pressure window.
    """
    n, pressure = len(breaths), breaths.pressure
    # Steps until the expiratory valve first opens.
    active = np.cumprod(breaths.u_out < 0.5, axis=1)[:, :-1] > 0
    known = np.isfinite(pressure)
    learnable = active & known[:, 1:]
    start = pressure[np.arange(n), np.argmax(known, axis=1)]
    steps = -(-int(active.sum(axis=1).max()) // _PAD_STEPS) * _PAD_STEPS
    more = -n % _PAD_BREATHS

    def pad(values: np.ndarray) -> Array:
        values = values[:, :steps]
        further = [(0, more), (0, steps - values.shape[1]), (0, 0)]
        return jnp.asarray(np.pad(values, further[: values.ndim]))

    # Before the first sample the windows hold the start, as a lung at rest does.
    past = np.concatenate([np.repeat(start[:, None], window, axis=1), pressure[:, 1:-1]], axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(past, window, axis=1)
    return Inspirations(
        start=jnp.asarray(np.pad(start, (0, more))),
        u_in=pad(np.where(active, breaths.u_in[:, :-1], 0.0)),
        dt=pad(np.where(active, breaths.dt[:, :-1], 0.0)),
        after=pad(np.where(learnable, pressure[:, 1:], 0.0)),
        weight=pad(learnable * weight[:, None]),
        window=pad(np.nan_to_num(windows)),
        known=pad(np.isfinite(windows)),
    )


def scales_of(data: Inspirations) -> Scales:
    """Means and standard deviations of what a network will be trained on."""
    used = np.asarray(data.weight) > 0
    pressure, u_in = np.asarray(data.after)[used], np.asarray(data.u_in)[used]
    now = np.asarray(data.window)[..., -1][used]
    both = np.asarray(data.known)[..., -1][used]
    change = float(np.std((pressure - now)[both])) if both.any() else 1.0
    return Scales(
        pressure_mean=float(pressure.mean()),
        pressure_scale=max(float(pressure.std()), 1.0),
        control_mean=float(u_in.mean()),
        control_scale=max(float(u_in.std()), 1.0),
        change_scale=max(change, 0.1),
    )


def horizon(config: Training, done: Array, steps: int) -> Array:
    """Open-loop steps between two measured windows, growing from 1 to the whole inspiration."""
    growth = max(1.0 - config.one_step - config.whole, 1e-6)
    share = jnp.clip((done - config.one_step) / growth, 0.0, 1.0)
    return jnp.where(share >= 1.0, steps + 1, jnp.floor(steps**share)).astype(jnp.int32)


def open_loop_loss(
    layers: tuple[Layers, Layers],
    network: Network,
    batch: Inspirations,
    measured: Array,
    config: Training,
) -> Array:
    """Soft absolute error of the next pressures, cmH2O, with the layers ``(general, boundary)``.

    A run starts anew from the measured window where ``measured`` is true, shape ``(n, T)``.
    """
    network = Network(*layers, network.scales, network.windows)
    known = batch.known & measured[..., None]
    pressure = network.run(batch.start, batch.u_in, batch.dt, batch.window, known)
    error = (pressure - batch.after) / config.softness
    cost = config.softness * (jnp.sqrt(1.0 + error**2) - 1.0)
    return jnp.sum(batch.weight * cost) / jnp.maximum(jnp.sum(batch.weight), 1.0)


@partial(jax.jit, static_argnames="config")
def _train(
    network: Network, data: Inspirations, count: Array, key: Array, config: Training
) -> tuple[Network, Array]:
    """All updates, on the first ``count`` breaths; returns the network and the losses."""
    adam = optimiser(config.steps, config.learning_rate, config.weight_decay)
    length = data.u_in.shape[1]

    def update(carry: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        layers, state = carry
        draw_key, phase_key, _ = jax.random.split(jax.random.fold_in(key, number), 3)
        rows = jax.random.randint(draw_key, (config.batch,), 0, count)
        batch = jax.tree.map(lambda x: x[rows], data)
        reach = horizon(config, number / config.steps, length)
        phase = jax.random.randint(phase_key, (config.batch, 1), 0, reach)
        # A run over the whole inspiration takes no measured window but the start.
        measured = ((jnp.arange(length) + phase) % reach == 0) & (reach <= length)
        loss, gradient = jax.value_and_grad(open_loop_loss)(
            layers, network, batch, measured, config
        )
        updates, state = adam.update(gradient, state, layers)
        return (optax.apply_updates(layers, updates), state), loss

    layers = network.general, network.boundary
    ((general, boundary), _), losses = jax.lax.scan(
        update, (layers, adam.init(layers)), jnp.arange(config.steps)
    )
    return Network(general, boundary, network.scales, network.windows), losses


def fit(
    breaths: Breaths, weight: Floats, shape: Architecture, config: Training, seed: int
) -> Network:
    """Train a network on recorded breaths.

    Args:
        breaths: n recorded breaths.
        weight: weight of each breath in the loss, shape ``(n,)``.
        shape: sizes of the network.
        config: settings of the training.
        seed: seed of weights and batches.

    Raises:
        FloatingPointError: if a loss is not finite.
    """
    data = inspirations(breaths, weight, shape.pressures)
    init_key, key = jax.random.split(jax.random.key(seed))
    network = untrained(init_key, shape, scales_of(data))
    network, losses = _train(network, data, jnp.asarray(len(breaths)), key, config)
    if not jnp.all(jnp.isfinite(losses)):
        raise FloatingPointError("training diverged: a loss is not finite")
    return network


@jax.jit
def simulate(network: Network, start: Array, u_in: Array, dt: Array) -> Array:
    """Pressures at the samples of inspirations, from the first on, cmH2O, shape ``(n, T)``.

    Args:
        network: a network.
        start: first pressure, cmH2O, shape ``(n,)``.
        u_in: inspiratory valve, %, shape ``(n, T)``.
        dt: time from each sample to the next, s, shape ``(n, T)``.
    """
    blank = jnp.zeros((*u_in.shape, network.windows[0]))
    after = network.run(start, u_in, dt, blank, blank > 0)
    return jnp.concatenate([start[:, None], after[:, :-1]], axis=1)
