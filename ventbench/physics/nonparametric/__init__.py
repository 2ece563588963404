"""Nonparametric components: places in the physics where an unnamed effect may act, with any shape.

A component is a set of basis terms, which have the hooks of a mechanism and are linear, or nearly,
in their coefficients. With all coefficients at zero it does nothing. A module here holds the basis
terms that act at one place; their base classes are below.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import jax
import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Mechanism, Parameter, Values


@dataclass(frozen=True)
class NonparametricComponent:
    """A place in the physics, and the basis terms of any effect there."""

    name: str  #: public name, such as ``f(V)``.
    terms: tuple[str, ...]  #: names of its basis terms, which are fitted together.
    meaning: str  #: the component in words.


#: All nonparametric components, by public name.
NONPARAMETRIC_COMPONENTS = {
    component.name: component
    for component in (
        NonparametricComponent(
            "f(u)",
            ("valve_shape",),
            "flow of the inspiratory valve depends on the command in another way",
        ),
        NonparametricComponent(
            "memory of u",
            ("command_memory", "command_plays", "supply_memory"),
            "flow of the inspiratory valve depends on what the command was before",
        ),
        NonparametricComponent(
            "f(p)",
            ("leak_shape",),
            "gas leaves beside the lung, by the pressure at the airway",
        ),
        NonparametricComponent(
            "f(Q)",
            ("flow_shape",),
            "the pressure drop of the airway depends on flow in another way",
        ),
        NonparametricComponent(
            "R(V)",
            ("volume_resistance",),
            "the resistance of the airway depends on the volume of the lung",
        ),
        NonparametricComponent(
            "R(direction)",
            ("direction_resistance",),
            "the resistance of the airway is another one outwards than inwards",
        ),
        NonparametricComponent(
            "f(V)",
            ("recoil_shape",),
            "the recoil of the lung depends on volume in another way",
        ),
        NonparametricComponent(
            "memory of p",
            ("recoil_memory",),
            "the recoil of the lung depends on what its volume was before",
        ),
        NonparametricComponent(
            "exhalation path",
            ("outlet_shape", "outlet_memory"),
            "the expiratory valve conducts in another way, or opens slowly",
        ),
        NonparametricComponent(
            "measurement",
            ("sensor_shape", "sensor_memory", "drift_shape"),
            "the sensor shows another pressure than that at the airway",
        ),
    )
}

Number = Array | float


@dataclass(frozen=True)
class PiecewiseQuadratic:
    """A smooth curve through zero whose slope is a straight line from knot to knot.

    Beyond the last knot it goes on straight, and so it does below the first, which is zero.
    """

    knots: tuple[float, ...]  #: rising, from 0.

    def __call__(self, x: Array, slopes: Sequence[Number]) -> tuple[Array, Array]:
        """Value and slope at ``x``, given the slopes at the knots."""
        value, slope = slopes[0] * x, slopes[0] + jnp.zeros_like(x)
        for j, (a, b) in _pairs(self.knots):
            bend, inside = (slopes[j + 1] - slopes[j]) / (b - a), _within(x, a, b)
            slope = slope + bend * inside
            value = value + bend * inside * (x - a - 0.5 * inside)
        return value, slope


def _pairs(knots: tuple[float, ...]) -> list[tuple[int, tuple[float, float]]]:
    return list(enumerate(pairwise(knots)))


def _within(x: Array, low: float, high: float) -> Array:
    """How far ``x`` lies beyond ``low``, at most up to ``high``."""
    bottom, top = jnp.asarray(low, x.dtype), jnp.asarray(high, x.dtype)
    return jax.lax.clamp(bottom, x, top) - bottom


def per_state(constants: tuple[float, ...], state: Array) -> Array:
    """K constants in a shape that broadcasts with several states ``(K, ...)``."""
    return jnp.asarray(constants, state.dtype).reshape(-1, *[1] * (state.ndim - 1))


class BasisTerm(Mechanism):
    """A mechanism whose parameters are the coefficients of a basis; it has no physical name."""

    #: Powers of what its curve depends on that a change of base parameters could produce as well.
    absorbed: tuple[int, ...] = ()

    def coefficients(self, values: Values) -> list[Array]:
        """Values of all coefficients, in order."""
        return [values[parameter.name] for parameter in self.description.parameters]

    def stacked(self, values: Values, state: Array) -> Array:
        """Coefficients in the shape of several states, ``(K, ...)``."""
        weights = self.coefficients(values)[: len(state)]
        return jnp.stack([jnp.broadcast_to(c, state.shape[1:]) for c in weights])


class Lines(BasisTerm):
    """Straight lines from knot to knot, and constant beyond the first and the last.

    The coefficients are the values at the knots but those where the curve is fixed at zero.
    """

    knots: tuple[float, ...]  #: rising.
    fixed: tuple[float, ...]  #: knots at which the curve is zero.

    def at_knots(self, values: Values) -> list[Number]:
        """Values at the knots."""
        free = iter(self.coefficients(values))
        return [0.0 if knot in self.fixed else next(free) for knot in self.knots]

    def curve(self, values: Values, x: Array) -> Array:
        """Value at ``x``."""
        at = self.at_knots(values)
        value = at[0] + 0.0 * x
        for j, (a, b) in _pairs(self.knots):
            value = value + (at[j + 1] - at[j]) / (b - a) * _within(x, a, b)
        return value

    def slope(self, values: Values, x: Array) -> Array:
        """Derivative by ``x``."""
        at, slope = self.at_knots(values), 0.0 * x
        for j, (a, b) in _pairs(self.knots):
            slope = slope + (at[j + 1] - at[j]) / (b - a) * ((x > a) & (x <= b))
        return slope


class FilterBank(BasisTerm):
    """First-order filters with fixed time constants, each weighed by a coefficient."""

    #: Time constants, s.
    taus: tuple[float, ...]
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """The resting flow in all filters, L/s."""
        return self.lasting(flow + 0.0 * pressure)

    def step(self, state: Array, x: Array, length: Array) -> Array:
        """Filters of ``x`` after an implicit step of ``length`` s."""
        taus = per_state(self.taus, state)
        return (taus * state + length * x) / (taus + length)

    def weighed(self, values: Values, states: Array) -> Array:
        """Sum of the filters ``(K, ...)``, weighed by the coefficients."""
        return jnp.sum(self.stacked(values, states) * states, axis=0)

    def lasting(self, x: Array) -> Array:
        """Filters of what has lasted for long, ``(K, ...)``."""
        return jnp.stack([x] * len(self.taus))


def coefficients(
    at: Iterable[str],
    unit: str,
    meaning: str,
    low: float | Iterable[float],
    high: float | Iterable[float],
    spread: float | Iterable[float],
    *,
    follows: str | None = None,
    scan: tuple[float, ...] = (),
) -> tuple[Parameter, ...]:
    """Parameters ``c1``, ``c2`` and so on, which start at zero and have a prior around zero.

    The meaning, and where each acts, ``at``, are words. Bounds and ``spread``, the prior standard
    deviation, are one for all or one for each; all else as of :class:`Parameter`.
    """
    at = list(at)

    def repeated(value: float | Iterable[float]) -> list[float]:
        if isinstance(value, int | float):
            return [float(value)] * len(at)
        return [float(number) for number in value]

    rows = zip(at, repeated(low), repeated(high), repeated(spread), strict=True)
    return tuple(
        Parameter(
            f"c{k}",
            unit,
            f"{meaning} {place}",
            bottom,
            top,
            0.0,
            0.0,
            0.5 * width,
            follows=follows,
            scan=scan,
            spread=width,
        )
        for k, (place, bottom, top, width) in enumerate(rows, 1)
    )
