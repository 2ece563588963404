"""The fit of the rigs: breaths differ, rigs differ, lungs and valves are shared.

A *rig* is one session of the recordings: a ventilator with a lung that somebody set up. Its
parameters are those of its lung plus those of its valve plus a deviation of its own. The deviation
is shrunk towards zero, the less so the more was recorded. Its prior has heavy tails (Student's t
with :data:`TAIL` degrees of freedom), so that a rig that is not what its label says moves away
alone and does not pull its lung with it. Lungs with the same labelled resistance share a resistor,
lungs with the same labelled compliance a spring. All valves are of one type, whose flow at 100 %
the data sheet states.

Within a rig the valve's gain and the lung's filling at the start differ from breath to breath, by
more than the sensor's noise and for no recorded reason. Each breath therefore has its own gain and
start, with heavy-tailed priors around those of its rig. Without them one odd breath would move its
rig; with them a rig is where its breaths are on the whole. A simulator leaves them out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from ventbench.plants.hybrid import DIRECTION_SUM, ELASTIC_KNOTS, PLAYS, VALVE_KNOTS, Hybrid
from ventbench.task.lungs import Lung
from ventbench.task.rollouts import open_loop
from ventbench.train.rigs.data import Groups, InspirationData, WholeBreaths

#: Kinds of rig that share parameters.
RIG_COUNT = 4

#: Orders of magnitude of what a kind of rig has of its own: delays and lags, s; L/cmH2O.
_KIND = {
    "valve_delay": 0.02,
    "valve_lag": 0.01,
    "sensor_lag": 0.01,
    "closing_delay": 0.03,
    "closing_lag": 0.01,
    "opening_delay": 0.05,
    "circuit_compliance": 0.0008,
}


@flax.struct.dataclass
class Pooled:
    """Unconstrained parameters; L settings, G kinds of rig, J sessions. Logarithms unless said."""

    slopes: Array  #: slopes of the valve's curve, L/s per %, shape ``(13,)``.
    slopes_rig: Array  #: deviation that is added to the slopes for a kind of rig, ``(G, 13)``.
    R: Array  #: laminar resistance, cmH2O/(L/s), ``(L,)``.
    K2: Array  #: quadratic resistance, cmH2O s2/L2, ``(L,)``.
    E: Array  #: elastance, cmH2O/L, ``(L,)``.
    stiffening: Array  #: ratio of the elastic curve's slope to that below each knot, ``(L, 5)``.
    offset: Array  #: elastic recoil minus pressure at rest, cmH2O, no logarithm, ``(L,)``.
    direction: Array  #: odds of the plays' weights, ``(G, 3)``.
    rising: Array  #: shift of the reading while the command rises, cmH2O, ``(G,)``.
    falling: Array  #: shift of the reading while the command falls, cmH2O, ``(G,)``.
    valve_delay: Array  #: dead time of the inspiratory valve, s, ``(G,)``.
    valve_lag: Array  #: time constant of the inspiratory valve, s, ``(G,)``.
    sensor_lag: Array  #: time constant of the sensor, s, ``(G,)``.
    closing_delay: Array  #: delay of the expiratory valve when it closes, s, ``(G,)``.
    opening_delay: Array  #: delay of the expiratory valve when it opens, s, ``(G,)``.
    circuit_compliance: Array  #: compliance of tubing and dead space, L/cmH2O, ``(G,)``.
    conductance: Array  #: conductance of the open expiratory valve, L/s per cmH2O, ``(G,)``.
    #: conductance of the expiratory valve while it closes, L/s per cmH2O, ``(G,)``.
    closing_conductance: Array
    rest: Array  #: command that held the flow before the first sample, %, ``()``.
    session_gain: Array  #: deviation that is added to all slopes, ``(J,)``.
    session_R: Array  #: deviation that is added to both resistances, ``(J,)``.
    session_K2: Array  #: deviation that is added to the quadratic resistance, ``(J,)``.
    session_E: Array  #: deviation that is added to the elastance, ``(J,)``.
    session_offset: Array  #: deviation that is added to the offset, cmH2O, no logarithm, ``(J,)``.
    session_conductance: Array  #: deviation that is added to the conductance, ``(J,)``.
    #: deviation that is added to the closing conductance, ``(J,)``.
    session_closing_conductance: Array
    closing_lag: Array  #: time constant with which the expiratory valve closes, s, ``(G,)``.


def direction(pooled: Pooled) -> Array:
    """Weights of the plays, negative, adding up to more than -``DIRECTION_SUM``, ``(G, 3)``.

    Negative ones make the valve answer more to the latest change, and a command held from rest
    still asks for more flow the higher it is.
    """
    odds = jnp.exp(pooled.direction)
    return -DIRECTION_SUM * odds / (1.0 + jnp.sum(odds, axis=-1, keepdims=True))


def stiffening(pooled: Pooled) -> Array:
    """Changes of the elastic curve's relative slope at its knots, ``(L, 5)``."""
    slope = jnp.exp(jnp.cumsum(pooled.stiffening, axis=-1))
    return jnp.diff(slope, axis=-1, prepend=jnp.ones_like(slope[:, :1]))


def plants(pooled: Pooled, groups: Groups) -> Hybrid:
    """Build the plants of breaths or sessions.

    Args:
        pooled: the parameters.
        groups: setting, kind of rig and session of each breath.

    Returns:
        Plants with leaves ``(n, ...)``.
    """
    lung, rig, session = groups.lung, groups.rig, groups.session
    gain = pooled.session_gain[session][:, None]
    laminar = pooled.R[lung] + pooled.session_R[session]
    quadratic = pooled.K2[lung] + pooled.session_R[session] + pooled.session_K2[session]
    return Hybrid(
        R=jnp.exp(laminar),
        K2=jnp.exp(quadratic),
        E=jnp.exp(pooled.E[lung] + pooled.session_E[session]),
        stiffening=stiffening(pooled)[lung],
        offset=pooled.offset[lung] + pooled.session_offset[session],
        slopes=jnp.exp(pooled.slopes + pooled.slopes_rig[rig] + gain),
        direction=direction(pooled)[rig],
        **{name: jnp.exp(getattr(pooled, name)[rig]) for name in (*_KIND, "rising", "falling")},
        conductance=jnp.exp(pooled.conductance[rig] + pooled.session_conductance[session]),
        closing_conductance=jnp.exp(
            pooled.closing_conductance[rig] + pooled.session_closing_conductance[session]
        ),
        rest=jnp.exp(pooled.rest) + jnp.zeros_like(laminar),
    )


#: Flow of the inspiratory valve at 100 %, L/s: data sheet of the SMC PVQ31.
SHEET_FLOW = 2.28

#: Degrees of freedom of the rigs' deviations.
TAIL = 3.0

#: Part of the labelled resistance that is laminar in a QuickLung, whose label holds at
#: :data:`LABEL_FLOW` only: at half that flow its resistance is 70 % of the label.
LAMINAR_SHARE = 0.4

#: Flow at which a labelled resistance holds, L/s.
LABEL_FLOW = 1.0

#: Least part of the label that the prior gives to either kind of resistance: its logarithm is
#: fitted.
LEAST_SHARE = 0.02

#: Command at which the flow of the data sheet holds, %.
FULL_OPENING = 100.0


@flax.struct.dataclass
class Scales:
    """Standard deviations of the prior; of logarithms unless a unit is named.

    Those of rigs are the spread of the public recordings' rigs that are what their label says.
    """

    sheet: float = 0.25  #: flow at 100 % around the data sheet.
    smoothness: float = 0.5  #: difference between neighbouring slopes of the valve's curve.
    valve_rig: float = 0.2  #: what a kind of valve adds to the slopes.
    smoothness_rig: float = 0.15  #: difference between neighbouring additions of a kind of valve.
    compliance: float = 0.1  #: compliance of a lung around its label.
    resistance: float = 0.5  #: both resistances of a lung around their label.
    #: elastances of lungs of one labelled compliance around their mean, relative to label.
    spring: float = 0.1
    resistor: float = 0.2  #: resistances of lungs of one labelled resistance around their mean.
    stiffening: float = 0.3  #: change of the elastic curve's slope at a knot.
    offset: float = 1.0  #: elastic recoil minus pressure at rest, of a lung, cmH2O.
    kind: float = 1.0  #: delays, lags, circuit and expiratory valve of a kind of rig.
    direction: float = 0.2  #: weights of the plays, no logarithm.
    reading: float = 0.5  #: shift of the reading by the direction of the command, cmH2O.
    rig_gain: float = 0.05  #: gain of the valve of a rig.
    rig_resistance: float = 0.1  #: both resistances of a rig.
    rig_quadratic: float = 0.15  #: further deviation of a rig's quadratic resistance.
    rig_elastance: float = 0.06  #: elastance of a rig.
    rig_offset: float = 0.3  #: offset of a rig, cmH2O.
    rig_expiration: float = 0.3  #: conductances of a rig's expiratory valve.


#: Scale of each field that has one of its own around its centre. ``None`` marks heavy tails.
_GAUSSIAN = {
    "slopes_rig": "valve_rig",
    "R": "resistance",
    "K2": "resistance",
    "E": "compliance",
    "stiffening": "stiffening",
    "offset": "offset",
    **dict.fromkeys((*_KIND, "conductance", "closing_conductance", "rest"), "kind"),
}
_HEAVY_TAILED = {
    "session_gain": "rig_gain",
    "session_R": "rig_resistance",
    "session_K2": "rig_quadratic",
    "session_E": "rig_elastance",
    "session_offset": "rig_offset",
    "session_conductance": "rig_expiration",
    "session_closing_conductance": "rig_expiration",
}


@flax.struct.dataclass
class Centre:
    """Centre of the prior, at which a fit starts."""

    pooled: Pooled  #: the parameters.
    sheet_flow: Array  #: logarithm of the flow at 100 %, L/s, ``()``.
    #: share of each lung in the mean of those with its labelled resistance, ``(L, L)``.
    same_resistor: Array
    same_spring: Array  #: the same for labelled compliances, ``(L, L)``.


def centre(labels: Sequence[Lung], sessions: int, laminar_share: float = LAMINAR_SHARE) -> Centre:
    """Labels, the data sheet, and orders of magnitude of the rest.

    Args:
        labels: the L lungs.
        sessions: number of rigs, J.
        laminar_share: part of the labelled resistance that does not depend on the flow.
    """
    laminar = min(max(laminar_share, LEAST_SHARE), 1.0 - LEAST_SHARE)
    resistance = np.array([lung.R for lung in labels])
    compliance = np.array([lung.C for lung in labels])

    def same(value: np.ndarray) -> Array:
        equal = value[:, None] == value
        return jnp.asarray(equal / equal.sum(axis=1, keepdims=True))

    knots = len(VALVE_KNOTS)

    def rig(value: float) -> np.ndarray:
        return np.full(RIG_COUNT, np.log(value))

    values: dict[str, Any] = dict(
        slopes=np.full(knots, np.log(SHEET_FLOW / FULL_OPENING)),
        slopes_rig=np.zeros((RIG_COUNT, knots)),
        R=np.log(laminar * resistance),
        K2=np.log((1.0 - laminar) * resistance / LABEL_FLOW),
        E=np.log(1000.0 / compliance),
        stiffening=np.zeros((len(labels), len(ELASTIC_KNOTS))),
        offset=np.zeros(len(labels)),
        direction=np.full((RIG_COUNT, len(PLAYS)), np.log(0.03)),
        rest=np.log(5.0),
        **{name: rig(value) for name, value in _KIND.items()},
        rising=rig(0.05),
        falling=rig(0.05),
        conductance=rig(0.2),
        closing_conductance=rig(0.2),
        **dict.fromkeys(_HEAVY_TAILED, np.zeros(sessions)),
    )
    pooled = Pooled(**{name: jnp.asarray(value, float) for name, value in values.items()})
    sheet = jnp.asarray(np.log(SHEET_FLOW))
    return Centre(pooled, sheet, same(resistance), same(compliance))


def full_flow(pooled: Pooled) -> Array:
    """Logarithm of the flow of the common valve curve at 100 %, L/s, ``()``."""
    widths = jnp.diff(jnp.append(jnp.asarray(VALVE_KNOTS), FULL_OPENING))
    return jnp.log(jnp.sum(jnp.exp(pooled.slopes) * widths))


def heavy_tailed(value: Array) -> Array:
    """Negative logarithm of Student's t density, up to a constant, summed."""
    return 0.5 * (TAIL + 1.0) * jnp.sum(jnp.log1p(value**2 / TAIL))


def penalty(pooled: Pooled, around: Centre, scales: Scales) -> Array:
    """Negative logarithm of the prior density, up to a constant."""

    def apart(name: str) -> Array:
        return getattr(pooled, name) - getattr(around.pooled, name)

    def gaussian(value: Array, scale: float) -> Array:
        return 0.5 * jnp.sum((value / scale) ** 2)

    terms = [gaussian(apart(name), getattr(scales, scale)) for name, scale in _GAUSSIAN.items()]
    terms += [
        heavy_tailed(apart(name) / getattr(scales, scale)) for name, scale in _HEAVY_TAILED.items()
    ]
    for name in ("R", "K2"):
        deviation = apart(name)
        terms.append(gaussian(deviation - around.same_resistor @ deviation, scales.resistor))
    deviation = apart("E")
    terms += [
        gaussian(deviation - around.same_spring @ deviation, scales.spring),
        gaussian(full_flow(pooled) - around.sheet_flow, scales.sheet),
        gaussian(jnp.diff(apart("slopes")), scales.smoothness),
        gaussian(jnp.diff(apart("slopes_rig"), axis=-1), scales.smoothness_rig),
        gaussian(direction(pooled), scales.direction),
        gaussian(jnp.exp(pooled.rising), scales.reading),
        gaussian(jnp.exp(pooled.falling), scales.reading),
    ]
    return sum(terms, start=jnp.zeros(()))


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
    measured = data.start_measured > 0
    start = jnp.where(measured, data.start, fitted.rig_start[data.groups.session]) + fitted.start
    return jnp.where(data.share > 0, simulate(plant, start, data) - data.pressure, 0.0)


def robust(error: Array, share: Array, softness: float, saturation: float) -> Array:
    """Mean absolute error of each breath, cmH2O, ``(n,)``; large ones count less and less.

    Args:
        error: cmH2O, shape ``(n, samples)``.
        share: weight of each sample in its breath, of the same shape.
        softness: error below which it turns from absolute to square, cmH2O.
        saturation: mean error above which a breath counts less, cmH2O.
    """
    breath = jnp.sum(share * (jnp.sqrt(error**2 + softness**2) - softness), axis=1)
    return saturation * jnp.log1p(breath / saturation)


def loss(
    fitted: Fitted,
    data: InspirationData,
    weight: Array,
    around: Centre,
    scales: Scales,
    noise: Noise,
    config: FitConfig,
) -> Array:
    """Negative logarithm of the posterior for each breath of weight one."""
    error = breath_errors(fitted, data)
    breath = robust(error, data.share, config.softness, noise.saturation)
    breath = breath * noise.independent / noise.pressure
    # A breath that counts for nothing still keeps its own latent values at zero.
    width = jnp.where(data.start_measured > 0, noise.start, noise.unknown_start_scale)
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
    carry: tuple[Fitted, Any],
    data: InspirationData,
    weight: Array,
    around: Centre,
    scales: Scales,
    noise: Noise,
    config: FitConfig,
) -> tuple[Fitted, Any]:
    optimiser = _optimiser(config)

    def iterate(carry: tuple[Fitted, Any], _: None) -> tuple[tuple[Fitted, Any], None]:
        fitted, state = carry
        gradient = jax.grad(loss)(fitted, data, weight, around, scales, noise, config)
        updates, state = optimiser.update(gradient, state)
        return (jax.tree.map(jnp.add, fitted, updates), state), None

    return jax.lax.scan(iterate, carry, None, length=CHUNK)[0]


def fit(
    data: InspirationData,
    weight: Array,
    around: Centre,
    config: FitConfig | None = None,
    start: Fitted | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> Fitted:
    """Fit all rigs at once, in the precision of the data.

    Args:
        data: n inspirations.
        weight: weight of each breath, ``(n,)``; 0 leaves it out.
        around: centre of the prior.
        config: settings of the optimisation.
        start: where to start; the centre if not given.
        progress: called with the share that is done, 0..1.
    """
    scales, noise, config = Scales(), Noise(), config or FitConfig()
    count, rigs = data.start.shape[0], around.pooled.session_gain.shape[0]
    fitted = start or Fitted(
        around.pooled,
        jnp.zeros(count),
        jnp.zeros(count),
        jnp.full(rigs, jnp.asarray(noise.unknown_start, float)),
    )
    carry: tuple[Fitted, Any] = (fitted, _optimiser(config).init(fitted))  # pyright: ignore[reportArgumentType]
    for iteration in range(0, config.iterations, CHUNK):
        carry = _advance(carry, data, weight, around, scales, noise, config)
        jax.block_until_ready(carry)  # so that Ctrl-C ends it, and progress is true
        progress((iteration + CHUNK) / config.iterations)
    return carry[0]


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
        data: data from :func:`complete_breaths`.
        weight: weight of each breath, shape ``(n,)``; 0 leaves it out.

    Returns:
        The parameters with those of :data:`EXPIRATORY_WIDTHS` moved.
    """
    start = {name: getattr(pooled, name) for name in EXPIRATORY_WIDTHS}
    optimiser = optax.adam(
        optax.cosine_decay_schedule(EXPIRATORY_LEARNING_RATE, EXPIRATORY_ITERATIONS, 0.01)
    )

    def loss(parameters: dict[str, Array]) -> Array:
        plant = plants(replace(pooled, **parameters), data.groups)
        simulated = open_loop(plant, data.pressure[:, 0], data.u_in, data.u_out, data.dt)
        error = jnp.where(data.share > 0, simulated - data.pressure, 0.0)
        breath = robust(error, data.share, EXPIRATORY_SOFTNESS, EXPIRATORY_SATURATION)
        moves = [
            jnp.sum(((parameters[name] - start[name]) / width) ** 2)
            for name, width in EXPIRATORY_WIDTHS.items()
        ]
        prior = 0.5 * EXPIRATORY_PRIOR * sum(moves)
        return (jnp.sum(weight * breath) + prior) / jnp.maximum(jnp.sum(weight), 1.0)

    def iterate(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        parameters, state = carry
        updates, state = optimiser.update(jax.grad(loss)(parameters), state)
        return (optax.apply_updates(parameters, updates), state), None

    (parameters, _), _ = jax.lax.scan(
        iterate, (start, optimiser.init(start)), None, length=EXPIRATORY_ITERATIONS
    )
    return replace(pooled, **parameters)
