"""The fit of the hybrid plant to recordings of all lung settings at once.

A robust loss over inspirations is minimised by Adam in one scan, compiled once for all members of
the ensemble. A second stage fits the expiratory valve, its conductance and opening delay, to whole
measured breaths; the inspirations have fixed everything else by then.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from numpy.typing import NDArray

from ventbench.errors import InputError
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.sessions import Sessions
from ventbench.recordings import Breaths, join
from ventbench.rollouts import open_loop
from ventbench.training.hybrid.data import (
    InspirationData,
    WholeBreaths,
    groups_of_sessions,
    inspirations,
    whole_breaths,
)
from ventbench.training.hybrid.parameters import (
    SESSION_ROOM,
    Pooled,
    initial,
    penalty,
    plants,
)

#: Iterations compiled into one scan; progress and Ctrl-C fall between two of them.
CHUNK = 20


@dataclass(frozen=True)
class HybridConfig:
    """Settings of the fit of a member; hashable, since they are static in compiled functions.

    Attributes:
        iterations: number of iterations of Adam, a multiple of ``CHUNK``.
        learning_rate: peak of the cosine schedule.
        softness: error below which the loss turns from absolute to square, cmH2O.
        saturation: breaths with a larger mean error count less and less, cmH2O.
        prior: weight of the prior, in breaths times cmH2O.
        reconstructed: weight of a reconstructed breath; a measured one has 1.
        R50: weight of a breath of a setting that is not scored.
        start_mean: belief about a first pressure that is blank, cmH2O.
        start_width: standard deviation of the prior of first pressures.
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
class HybridParameters:
    """The fitted quantities: pooled parameters and first pressures, cmH2O, ``(n,)``."""

    pooled: Pooled
    start: Array


def simulate(plant: Hybrid, start: Array, data: InspirationData) -> Array:
    """Pressures at the end of each command of the inspirations, cmH2O, ``(n, SAMPLES - 1)``."""

    def step(state: Any, command: tuple[Array, Array]) -> tuple[Any, Array]:
        u_in, dt = command
        return plant.step(state, u_in, jnp.zeros_like(u_in), dt)

    _, pressure = jax.lax.scan(step, plant.init(start), (data.u_in.T, data.dt.T))
    return pressure.T


def errors(parameters: HybridParameters, data: InspirationData, config: HybridConfig) -> Array:
    """Simulated minus recorded pressure, cmH2O, 0 where none counts, ``(n, SAMPLES - 1)``."""
    plant = plants(parameters.pooled, data.groups, directed=config.directed)
    start = jnp.where(data.start_known > 0, data.start, parameters.start)
    return jnp.where(data.share > 0, simulate(plant, start, data) - data.pressure, 0.0)


def loss(
    parameters: HybridParameters, data: InspirationData, weight: Array, config: HybridConfig
) -> Array:
    """Robust mean error and prior; ``weight`` has shape ``(n,)``."""
    soft, saturation = config.softness, config.saturation
    error = errors(parameters, data, config)
    breath = jnp.sum(data.share * (jnp.sqrt(error**2 + soft**2) - soft), axis=1)
    breath = saturation * jnp.log1p(breath / saturation)
    starts = jnp.sum((parameters.start - config.start_mean) ** 2) / config.start_width**2
    prior = penalty(parameters.pooled) + 0.5 * starts
    return (jnp.sum(weight * breath) + config.prior * prior) / jnp.sum(weight)


def _optimiser(config: HybridConfig) -> optax.GradientTransformation:
    peak, warm_up = config.learning_rate, min(30, config.iterations // 4)
    return optax.adam(
        optax.warmup_cosine_decay_schedule(
            0.1 * peak, peak, warm_up, config.iterations, 0.01 * peak
        )
    )


@partial(jax.jit, static_argnames="config")
def _advance(
    carry: tuple[HybridParameters, Any], data: InspirationData, weight: Array, config: HybridConfig
) -> tuple[tuple[HybridParameters, Any], Array]:
    optimiser = _optimiser(config)

    def iterate(
        carry: tuple[HybridParameters, Any], _: None
    ) -> tuple[tuple[HybridParameters, Any], Array]:
        parameters, state = carry
        value, gradient = jax.value_and_grad(loss)(parameters, data, weight, config)
        updates, state = optimiser.update(gradient, state)
        parameters = jax.tree.map(jnp.add, parameters, updates)
        return (parameters, state), value

    return jax.lax.scan(iterate, carry, None, length=CHUNK)


def fit(
    data: InspirationData,
    weight: Array,
    config: HybridConfig,
    progress: Callable[[int, float], None] | None = None,
) -> tuple[Pooled, float]:
    """Fit the pooled parameters; call it within :func:`ventbench.precision.float64`.

    Args:
        data: data from :func:`~ventbench.training.hybrid.data.inspirations`.
        weight: weight of each breath, shape ``(n,)``; 0 leaves it out.
        config: settings of the fit.
        progress: called with iterations done and the loss, cmH2O.

    Returns:
        The parameters and the loss.
    """
    parameters = HybridParameters(initial(), jnp.full_like(data.start, config.start_mean))
    carry = (parameters, _optimiser(config).init(parameters))  # pyright: ignore[reportArgumentType]
    value = jnp.inf
    for done in range(0, config.iterations, CHUNK):
        carry, values = _advance(carry, data, weight, config)
        value = values[-1]
        if progress is not None:
            progress(done + CHUNK, float(value))
    return carry[0].pooled, float(value)


@partial(jax.jit, static_argnames="config")
def mean_absolute_errors(pooled: Pooled, data: InspirationData, config: HybridConfig) -> Array:
    """Open-loop error of each breath whose first pressure is known, cmH2O, ``(n,)``."""
    parameters = HybridParameters(pooled, jnp.full_like(data.start, config.start_mean))
    return jnp.sum(data.share * jnp.abs(errors(parameters, data, config)), axis=1)


#: Parameters that the second stage fits, and the prior standard deviation of their logarithms.
EXPIRATORY_WIDTHS = {"conductance": 1.0, "session_conductance": 0.3, "opening_delay": 0.7}

EXPIRATORY_ITERATIONS, EXPIRATORY_LEARNING_RATE = 80, 0.05


@partial(jax.jit, static_argnames="config")
def fit_expiration(
    pooled: Pooled, data: WholeBreaths, weight: Array, config: HybridConfig
) -> Pooled:
    """Fit the expiratory valve; call it within :func:`ventbench.precision.float64`.

    Args:
        pooled: pooled parameters from :func:`fit`.
        data: data from :func:`whole_breaths`.
        weight: weight of each breath, shape ``(n,)``; 0 leaves it out.
        config: settings of the first stage.

    Returns:
        The parameters with those of :data:`EXPIRATORY_WIDTHS` moved.
    """
    start = {name: getattr(pooled, name) for name in EXPIRATORY_WIDTHS}
    optimiser = optax.adam(
        optax.cosine_decay_schedule(EXPIRATORY_LEARNING_RATE, EXPIRATORY_ITERATIONS, 0.01)
    )
    soft, saturation = config.softness, config.saturation

    def loss(moved: dict[str, Array]) -> Array:
        plant = plants(replace(pooled, **moved), data.groups, directed=config.directed)
        simulated = open_loop(plant, data.pressure[:, 0], data.u_in, data.u_out, data.dt)
        error = jnp.where(data.share > 0, simulated - data.pressure, 0.0)
        breath = jnp.sum(data.share * (jnp.sqrt(error**2 + soft**2) - soft), axis=1)
        breath = saturation * jnp.log1p(breath / saturation)
        moves = [
            jnp.sum(((moved[name] - start[name]) / EXPIRATORY_WIDTHS[name]) ** 2)
            for name in EXPIRATORY_WIDTHS
        ]
        prior = 0.5 * config.prior * sum(moves)
        return (jnp.sum(weight * breath) + prior) / jnp.maximum(jnp.sum(weight), 1.0)

    def iterate(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        moved, state = carry
        updates, state = optimiser.update(jax.grad(loss)(moved), state)
        return (optax.apply_updates(moved, updates), state), None

    (moved, _), _ = jax.lax.scan(
        iterate, (start, optimiser.init(start)), None, length=EXPIRATORY_ITERATIONS
    )
    return replace(pooled, **moved)


@flax.struct.dataclass
class TrainingSet:
    """Recordings arranged once for all members, so that all share one compilation.

    Attributes:
        inspirations: inspirations of the measured, then of the reconstructed breaths.
        whole: the measured breaths.
        weight: weight of each inspiration, ``(n,)``.
        fold: fold of each inspiration, -1 for a reconstructed breath, ``(n,)``.
    """

    inspirations: InspirationData
    whole: WholeBreaths
    weight: Array
    fold: Array


def training_set(
    measured: Breaths,
    reconstructed: Breaths,
    fold: NDArray[np.int64],
    sessions: Sessions,
    config: HybridConfig,
) -> TrainingSet:
    """Arrange recordings; call it within :func:`ventbench.precision.float64`.

    Args:
        measured: m breaths.
        reconstructed: breaths that every member may see; their weight is the settings'.
        fold: fold of each measured breath, shape ``(m,)``.
        sessions: sessions by whose sampling times breaths belong together.
        config: gives the weights.

    Raises:
        InputError: as :func:`~ventbench.training.hybrid.data.inspirations`, or there are too many
            sessions.
    """
    if len(sessions) > SESSION_ROOM:
        raise InputError(f"{len(sessions)} sessions are more than the {SESSION_ROOM} there can be")
    breaths = join([measured, reconstructed])
    weight = np.append(np.ones(len(measured)), np.full(len(reconstructed), config.reconstructed))
    return TrainingSet(
        inspirations(breaths, sessions),
        whole_breaths(measured, sessions),
        jnp.asarray(weight * np.where(breaths.R == 50.0, config.R50, 1.0)),
        jnp.asarray(np.append(fold, np.full(len(reconstructed), -1))),
    )


def fit_member(
    data: TrainingSet,
    held_out: int,
    config: HybridConfig,
    progress: Callable[[float], None] | None = None,
) -> Pooled:
    """Fit one member; call it within :func:`ventbench.precision.float64`.

    Args:
        data: data from :func:`training_set`.
        held_out: the fold whose breaths count for nothing.
        config: the settings that ``data`` was made with.
        progress: called with the share that is done, 0..1.
    """
    weight = jnp.where(data.fold == held_out, 0.0, data.weight)

    def report(done: int, _: float) -> None:
        if progress is not None:
            progress(done / config.iterations)

    pooled, _ = fit(data.inspirations, weight, config, report)
    return fit_expiration(pooled, data.whole, weight[: data.whole.u_in.shape[0]], config)


def session_plants(pooled: Pooled, sessions: Sessions, config: HybridConfig) -> Hybrid:
    """Plants of all sessions, leaves ``(sessions, ...)``."""
    return plants(pooled, groups_of_sessions(sessions), directed=config.directed)
