"""Fitted parameters of the hybrid plant, unconstrained and pooled over lungs, rigs and sessions.

Their prior is Gaussian around the point at which every fit starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.lungs import RECORDED_LUNGS, Lung
from ventbench.plants.hybrid import ELASTIC_KNOTS, PLAYS, VALVE_KNOTS, Hybrid

#: Settings and kinds of rig that share parameters.
LUNG_COUNT, RIG_COUNT = len(RECORDED_LUNGS), 4

#: Most sessions that a fit can hold; tables are padded to it, so that all share one compilation.
SESSION_ROOM = 40

#: The plays' weights add up to less than this, so that pressure rises with a command held.
DIRECTION_SUM = 0.98


@flax.struct.dataclass
class Groups:
    """Setting, kind of rig and session of each breath, as indices, shape ``(n,)``."""

    lung: Array
    rig: Array
    session: Array


@flax.struct.dataclass
class Pooled:
    """Unconstrained parameters; L settings, G kinds of rig, J sessions. Logarithms unless said.

    Attributes:
        slopes: slopes of the valve's curve, L/s per %, shape ``(13,)``.
        slopes_rig: deviation that is added to the slopes for a kind of rig, ``(G, 13)``.
        R: laminar resistance, cmH2O/(L/s), ``(L,)``.
        K2: quadratic resistance, cmH2O s2/L2, ``(L,)``.
        E: elastance, cmH2O/L, ``(L,)``.
        stiffening: ratio of the elastic curve's slope to that below each knot, ``(L, 5)``.
        offset: elastic recoil minus pressure at rest, cmH2O, no logarithm, ``(L,)``.
        direction: odds of the plays' weights, ``(G, 3)``.
        rising: shift of the reading while the command rises, cmH2O, ``(G,)``.
        falling: shift of the reading while the command falls, cmH2O, ``(G,)``.
        valve_delay: dead time of the inspiratory valve, s, ``(G,)``.
        valve_lag: time constant of the inspiratory valve, s, ``(G,)``.
        sensor_lag: time constant of the sensor, s, ``(G,)``.
        closing_delay: delay of the expiratory valve when it closes, s, ``(G,)``.
        opening_delay: delay of the expiratory valve when it opens, s, ``(G,)``.
        circuit_compliance: compliance of tubing and dead space, L/cmH2O, ``(G,)``.
        conductance: conductance of the open expiratory valve, L/s per cmH2O, ``(G,)``.
        closing_conductance: conductance of the expiratory valve while it closes, L/s per cmH2O,
            ``(G,)``.
        rest: command that held the flow before the first sample, %, ``()``.
        session_gain: deviation that is added to all slopes, ``(J,)``.
        session_R: deviation that is added to both resistances, ``(J,)``.
        session_K2: deviation that is added to the quadratic resistance, ``(J,)``.
        session_E: deviation that is added to the elastance, ``(J,)``.
        session_offset: deviation that is added to the offset, cmH2O, no logarithm, ``(J,)``.
        session_conductance: deviation that is added to the conductance, ``(J,)``.
        session_closing_conductance: deviation that is added to the closing conductance, ``(J,)``.
        closing_lag: time constant with which the expiratory valve closes, s, ``(G,)``; None for one
            that closes at once, as in version 1 of the simulators.
    """

    slopes: Array
    slopes_rig: Array
    R: Array
    K2: Array
    E: Array
    stiffening: Array
    offset: Array
    direction: Array
    rising: Array
    falling: Array
    valve_delay: Array
    valve_lag: Array
    sensor_lag: Array
    closing_delay: Array
    opening_delay: Array
    circuit_compliance: Array
    conductance: Array
    closing_conductance: Array
    rest: Array
    session_gain: Array
    session_R: Array
    session_K2: Array
    session_E: Array
    session_offset: Array
    session_conductance: Array
    session_closing_conductance: Array
    closing_lag: Array | None = None


def initial(labels: Sequence[Lung] = RECORDED_LUNGS, sessions: int = SESSION_ROOM) -> Pooled:
    """Parameters at the start of every fit: labels, and the data sheet's orders of magnitude.

    Args:
        labels: the L lungs.
        sessions: number of sessions, J.
    """
    knots = len(VALVE_KNOTS)
    resistance = np.array([lung.R for lung in labels])
    elastance = np.array([1000.0 / lung.C for lung in labels])

    def rig(value: float) -> np.ndarray:
        return np.full(RIG_COUNT, np.log(value))

    session = np.zeros(sessions)
    values: dict[str, Any] = dict(
        slopes=np.full(knots, np.log(0.02)),
        slopes_rig=np.zeros((RIG_COUNT, knots)),
        R=np.log(0.4 * resistance),
        K2=np.log(0.6 * resistance),
        E=np.log(elastance),
        stiffening=np.zeros((len(labels), len(ELASTIC_KNOTS))),
        offset=np.zeros(len(labels)),
        direction=np.full((RIG_COUNT, len(PLAYS)), np.log(0.03)),
        rising=rig(0.05),
        falling=rig(0.05),
        valve_delay=rig(0.02),
        valve_lag=rig(0.01),
        sensor_lag=rig(0.01),
        closing_delay=rig(0.03),
        opening_delay=rig(0.05),
        circuit_compliance=rig(0.0008),
        conductance=rig(0.2),
        closing_conductance=rig(0.2),
        rest=np.log(5.0),
        session_gain=session,
        session_R=session,
        session_K2=session,
        session_E=session,
        session_offset=session,
        session_conductance=session,
        session_closing_conductance=session,
    )
    return Pooled(**{name: jnp.asarray(value, float) for name, value in values.items()})


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


def plants(pooled: Pooled, groups: Groups, *, directed: bool = True) -> Hybrid:
    """Build the plants of breaths or sessions.

    Args:
        pooled: the parameters.
        groups: setting, kind of rig and session of each breath.
        directed: whether the direction of the command has an effect.

    Returns:
        Plants with leaves ``(n, ...)``.
    """
    lung, rig, session = groups.lung, groups.rig, groups.session
    gain = pooled.session_gain[session][:, None]
    on = 1.0 if directed else 0.0
    laminar = pooled.R[lung] + pooled.session_R[session]
    quadratic = pooled.K2[lung] + pooled.session_R[session] + pooled.session_K2[session]
    return Hybrid(
        R=jnp.exp(laminar),
        K2=jnp.exp(quadratic),
        E=jnp.exp(pooled.E[lung] + pooled.session_E[session]),
        stiffening=stiffening(pooled)[lung],
        offset=pooled.offset[lung] + pooled.session_offset[session],
        slopes=jnp.exp(pooled.slopes + pooled.slopes_rig[rig] + gain),
        direction=on * direction(pooled)[rig],
        valve_delay=jnp.exp(pooled.valve_delay[rig]),
        valve_lag=jnp.exp(pooled.valve_lag[rig]),
        circuit_compliance=jnp.exp(pooled.circuit_compliance[rig]),
        sensor_lag=jnp.exp(pooled.sensor_lag[rig]),
        rising=on * jnp.exp(pooled.rising[rig]),
        falling=on * jnp.exp(pooled.falling[rig]),
        conductance=jnp.exp(pooled.conductance[rig] + pooled.session_conductance[session]),
        closing_conductance=jnp.exp(
            pooled.closing_conductance[rig] + pooled.session_closing_conductance[session]
        ),
        opening_delay=jnp.exp(pooled.opening_delay[rig]),
        closing_delay=jnp.exp(pooled.closing_delay[rig]),
        rest=jnp.exp(pooled.rest) + jnp.zeros_like(laminar),
        closing_lag=None if pooled.closing_lag is None else jnp.exp(pooled.closing_lag[rig]),
    )


#: Standard deviation of each field around its start; fields not named are free.
PRIOR_WIDTHS = {
    "slopes_rig": 0.2,
    "stiffening": 0.3,
    "offset": 1.0,
    "valve_delay": 1.0,
    "valve_lag": 1.0,
    "sensor_lag": 1.0,
    "closing_delay": 1.0,
    "opening_delay": 1.0,
    "circuit_compliance": 0.7,
    "conductance": 1.0,
    "closing_conductance": 1.0,
    "session_gain": 0.3,
    "session_R": 0.5,
    "session_K2": 0.5,
    "session_E": 0.4,
    "session_offset": 0.5,
    "session_conductance": 0.3,
    "session_closing_conductance": 0.3,
}

#: Standard deviations of the difference between neighbouring slopes of the valve's curve, and
#: between neighbouring additions of a rig to them.
SMOOTHNESS, SMOOTHNESS_RIG = 0.5, 0.15

#: Standard deviations around zero of the plays' weights, and of the effects on the reading, cmH2O.
DIRECTION, READING = 0.2, 0.5


def penalty(pooled: Pooled) -> Array:
    """Negative logarithm of the prior probability, up to a constant."""
    start = initial()
    squares = [
        jnp.sum(((getattr(pooled, name) - getattr(start, name)) / width) ** 2)
        for name, width in PRIOR_WIDTHS.items()
    ]
    squares += [
        jnp.sum((jnp.diff(pooled.slopes) / SMOOTHNESS) ** 2),
        jnp.sum((jnp.diff(pooled.slopes_rig, axis=-1) / SMOOTHNESS_RIG) ** 2),
        jnp.sum((direction(pooled) / DIRECTION) ** 2),
        jnp.sum((jnp.exp(pooled.rising) / READING) ** 2),
        jnp.sum((jnp.exp(pooled.falling) / READING) ** 2),
    ]
    return 0.5 * sum(squares, start=jnp.zeros(()))
