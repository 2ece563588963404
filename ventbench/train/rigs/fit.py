"""The fit of the rigs: breaths differ, rigs differ, lungs and valves are shared.

Within a rig the valve's gain and the lung's filling at the start differ from breath to breath, by
more than the sensor's noise and for no recorded reason. Each breath therefore has its own gain and
start, with heavy-tailed priors around those of its rig. Without them one odd breath would move its
rig; with them a rig is where its breaths are on the whole. A simulator leaves them out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
from jax import Array

from ventbench.plants.hybrid import Hybrid
from ventbench.task.rollouts import open_loop
from ventbench.train.rigs.data import InspirationData, WholeBreaths
from ventbench.train.rigs.parameters import Centre, Pooled, Scales, heavy_tailed, penalty, plants

#: Iterations compiled into one scan; progress and Ctrl-C fall between two of them.
CHUNK = 20


@flax.struct.dataclass
class Noise:
    """What differs from breath to breath."""

    pressure: float = 0.25  #: scale of the error of a sample, cmH2O.
    #: samples of a breath that count as independent; errors of neighbours are alike.
    independent: float = 10.0
    saturation: float = 1.5  #: breaths whose mean error is larger count less and less, cmH2O.
    gain: float = 0.02  #: scale of the logarithm of a breath's gain.
    start: float = 0.2  #: scale of the start of a breath around its recorded first pressure, cmH2O.
    unknown_start: float = 6.0  #: mean of first pressures that were not recorded, cmH2O.
    unknown_start_scale: float = 0.5  #: scale of one of those around the mean of its rig, cmH2O.
    rig_start: float = 0.6  #: standard deviation of a rig's mean first pressure around that, cmH2O.


@dataclass(frozen=True)
class FitConfig:
    """Settings of the optimisation; hashable, since they are static in compiled functions."""

    iterations: int = 160  #: iterations of Adam, a multiple of ``CHUNK``.
    learning_rate: float = 0.05  #: peak of the cosine schedule.
    softness: float = 0.1  #: error below which the loss turns from absolute to square, cmH2O.


@flax.struct.dataclass
class Fitted:
    """The fitted quantities."""

    pooled: Pooled  #: parameters of valves, lungs and rigs.
    gain: Array  #: logarithm of each breath's gain, ``(n,)``.
    start: Array  #: deviation of each breath's start, cmH2O, ``(n,)``.
    rig_start: Array  #: mean first pressure of each rig where it was not recorded, cmH2O, ``(J,)``.


def simulate(plant: Hybrid, start: Array, data: InspirationData) -> Array:
    """Pressures at the end of each command of the inspirations, cmH2O, ``(n, SAMPLES - 1)``."""

    def step(state: Any, command: tuple[Array, Array]) -> tuple[Any, Array]:
        u_in, dt = command
        state, signals = plant.step(state, u_in, jnp.zeros_like(u_in), dt)
        return state, signals.reading

    _, pressure = jax.lax.scan(step, plant.init(start)[0], (data.u_in.T, data.dt.T))
    return pressure.T


def breath_errors(fitted: Fitted, data: InspirationData) -> Array:
    """Simulated minus recorded pressure, cmH2O, 0 where none counts, ``(n, samples)``."""
    plant = plants(fitted.pooled, data.groups)
    plant = plant.replace(  # type: ignore[attr-defined]
        slopes=plant.slopes * jnp.exp(fitted.gain)[:, None]
    )
    known = data.start_known > 0
    start = jnp.where(known, data.start, fitted.rig_start[data.groups.session]) + fitted.start
    return jnp.where(data.share > 0, simulate(plant, start, data) - data.pressure, 0.0)


def loss(
    fitted: Fitted, data: InspirationData, weight: Array, around: Centre, scales: Scales,
    noise: Noise, config: FitConfig,
) -> Array:  # fmt: skip
    """Negative logarithm of the posterior for each breath of weight one."""
    soft = config.softness
    error = breath_errors(fitted, data)
    breath = jnp.sum(data.share * (jnp.sqrt(error**2 + soft**2) - soft), axis=1)
    breath = noise.saturation * jnp.log1p(breath / noise.saturation)
    breath = breath * noise.independent / noise.pressure
    # A breath that counts for nothing still keeps its own latent values at zero.
    width = jnp.where(data.start_known > 0, noise.start, noise.unknown_start_scale)
    latent = heavy_tailed(fitted.gain / noise.gain) + heavy_tailed(fitted.start / width)
    rigs = 0.5 * jnp.sum(((fitted.rig_start - noise.unknown_start) / noise.rig_start) ** 2)
    prior = penalty(fitted.pooled, around, scales) + latent + rigs
    return (jnp.sum(weight * breath) + prior) / jnp.maximum(jnp.sum(weight), 1.0)


def _optimiser(config: FitConfig) -> optax.GradientTransformation:
    peak, warm_up = config.learning_rate, min(30, config.iterations // 4)
    return optax.adam(
        optax.warmup_cosine_decay_schedule(
            0.1 * peak, peak, warm_up, config.iterations, 0.01 * peak
        )
    )


@partial(jax.jit, static_argnames="config")
def _advance(
    carry: tuple[Fitted, Any], data: InspirationData, weight: Array, around: Centre,
    scales: Scales, noise: Noise, config: FitConfig,
) -> tuple[tuple[Fitted, Any], Array]:  # fmt: skip
    optimiser = _optimiser(config)

    def iterate(carry: tuple[Fitted, Any], _: None) -> tuple[tuple[Fitted, Any], Array]:
        fitted, state = carry
        value, gradient = jax.value_and_grad(loss)(
            fitted, data, weight, around, scales, noise, config
        )
        updates, state = optimiser.update(gradient, state)
        return (jax.tree.map(jnp.add, fitted, updates), state), value

    return jax.lax.scan(iterate, carry, None, length=CHUNK)


def fit(
    data: InspirationData,
    weight: Array,
    around: Centre,
    scales: Scales | None = None,
    noise: Noise | None = None,
    config: FitConfig | None = None,
    start: Fitted | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Fitted, float]:
    """Fit all rigs at once, in the precision of the data.

    Args:
        data: n inspirations.
        weight: weight of each breath, ``(n,)``; 0 leaves it out.
        around: centre of the prior.
        scales: widths of the prior.
        noise: what differs from breath to breath.
        config: settings of the optimisation.
        start: where to start; the centre if not given.
        progress: called with the share that is done, 0..1.

    Returns:
        The fit, and its loss.
    """
    scales, noise, config = scales or Scales(), noise or Noise(), config or FitConfig()
    count, rigs = data.start.shape[0], around.pooled.session_gain.shape[0]
    fitted = start or Fitted(
        around.pooled,
        jnp.zeros(count),
        jnp.zeros(count),
        jnp.full(rigs, jnp.asarray(noise.unknown_start, float)),
    )
    carry: tuple[Fitted, Any] = (fitted, _optimiser(config).init(fitted))  # pyright: ignore[reportArgumentType]
    value = float("inf")
    for done in range(0, config.iterations, CHUNK):
        carry, values = _advance(carry, data, weight, around, scales, noise, config)
        value = float(values[-1])
        if progress is not None:
            progress((done + CHUNK) / config.iterations)
    return carry[0], value


#: Parameters that the second stage fits, and the prior standard deviation of their logarithms.
EXPIRATORY_WIDTHS = {"conductance": 1.0, "session_conductance": 0.3, "opening_delay": 0.7}

#: Settings of its optimisation.
EXPIRATORY_ITERATIONS, EXPIRATORY_LEARNING_RATE = 80, 0.05

#: Error below which its loss turns from absolute to square, and mean error of a breath above which
#: the breath counts less and less, cmH2O; weight of the prior, in breaths times cmH2O.
EXPIRATORY_SOFTNESS, EXPIRATORY_SATURATION, EXPIRATORY_PRIOR = 0.1, 2.0, 0.0135


@jax.jit
def fit_expiration(pooled: Pooled, data: WholeBreaths, weight: Array) -> Pooled:
    """Fit the expiratory valve; the inspirations have fixed everything else.

    Args:
        pooled: pooled parameters from :func:`fit`.
        data: data from :func:`whole_breaths`.
        weight: weight of each breath, shape ``(n,)``; 0 leaves it out.

    Returns:
        The parameters with those of :data:`EXPIRATORY_WIDTHS` moved.
    """
    start = {name: getattr(pooled, name) for name in EXPIRATORY_WIDTHS}
    optimiser = optax.adam(
        optax.cosine_decay_schedule(EXPIRATORY_LEARNING_RATE, EXPIRATORY_ITERATIONS, 0.01)
    )
    soft, saturation = EXPIRATORY_SOFTNESS, EXPIRATORY_SATURATION

    def loss(moved: dict[str, Array]) -> Array:
        plant = plants(replace(pooled, **moved), data.groups)
        simulated = open_loop(plant, data.pressure[:, 0], data.u_in, data.u_out, data.dt)
        error = jnp.where(data.share > 0, simulated - data.pressure, 0.0)
        breath = jnp.sum(data.share * (jnp.sqrt(error**2 + soft**2) - soft), axis=1)
        breath = saturation * jnp.log1p(breath / saturation)
        moves = [
            jnp.sum(((moved[name] - start[name]) / EXPIRATORY_WIDTHS[name]) ** 2)
            for name in EXPIRATORY_WIDTHS
        ]
        prior = 0.5 * EXPIRATORY_PRIOR * sum(moves)
        return (jnp.sum(weight * breath) + prior) / jnp.maximum(jnp.sum(weight), 1.0)

    def iterate(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        moved, state = carry
        updates, state = optimiser.update(jax.grad(loss)(moved), state)
        return (optax.apply_updates(moved, updates), state), None

    (moved, _), _ = jax.lax.scan(
        iterate, (start, optimiser.init(start)), None, length=EXPIRATORY_ITERATIONS
    )
    return replace(pooled, **moved)
