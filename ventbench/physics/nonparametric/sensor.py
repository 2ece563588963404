"""Errors of the pressure sensor: a curve, filters, and a drift over the recording."""

import jax
import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Pair, Values
from ventbench.physics.nonparametric import FilterBank, Lines, coefficients

#: Pressures where the curve bends, cmH2O.
_SENSOR_KNOTS = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0)

#: Those at which it is zero.
_SENSOR_FIXED = (5.0, 20.0)

#: Steps of the search for the pressure of a reading, and the least slope it reckons with.
_SENSOR_STEPS, _SENSOR_LEAST = 6, 0.2


class SensorShape(Lines):
    """An error of the reading that depends on the pressure.

    It is zero at 5 and at 20 cmH2O: an offset is one of PEEP and of the start, and a gain, from
    pressure alone, a common scale of R, 1/C and R_ex.
    """

    description = Description(
        name="sensor_shape",
        title="measurement: any curve of the pressure sensor",
        site="sensor",
        equation="y = p + f(p), f straight between knots, f(5 cmH2O) = f(20 cmH2O) = 0",
        parameters=coefficients(
            (f"{p:g} cmH2O" for p in _SENSOR_KNOTS if p not in _SENSOR_FIXED),
            unit="cmH2O",
            meaning="error of the reading at",
            low=-4.0,
            high=4.0,
            spread=1.5,
        ),
        source="Straight lines between fixed knots; sensors that saturate, tables of calibration.",
        signature="Error that follows the pressure itself, whatever the flow is.",
        confusable=("nonlinear_compliance", "leak"),
    )
    absorbed = (0, 1)
    rank = 2
    knots, fixed = _SENSOR_KNOTS, _SENSOR_FIXED

    def sensor_output(self, values: Values, pressure: Array, position: Array) -> Array:
        """Add the error."""
        return pressure + self.curve(values, pressure)

    def sensor_input(self, values: Values, recorded: Array, position: Array) -> Array:
        """Pressure of a reading, by Newton's method."""

        def nearer(pressure: Array, _: None) -> tuple[Array, None]:
            slope = jnp.maximum(1.0 + self.slope(values, pressure), _SENSOR_LEAST)
            off = pressure + self.curve(values, pressure) - recorded
            return pressure - off / slope, None

        # In the shape that the steps have.
        first = recorded + sum(0.0 * x for x in self.at_knots(values))
        return jax.lax.scan(nearer, first, None, length=_SENSOR_STEPS)[0]


#: Time constants, s.
_MEMORY_TAUS = (0.02, 0.08, 0.3)


class SensorMemory(FilterBank):
    """A bank of first-order filters on the reading; a lasting pressure is shown as it is."""

    description = Description(
        name="sensor_memory",
        title="measurement: any linear memory of the pressure sensor",
        site="sensor",
        equation="y = p + sum_k c_k (s_k - p), tau_k ds_k/dt = p - s_k",
        parameters=coefficients(
            (f"{1e3 * tau:g} ms" for tau in _MEMORY_TAUS),
            unit="1",
            meaning="share of the reading that comes late by",
            low=-3.0,
            high=3.0,
            spread=1.0,
        ),
        source="Sum of fixed exponentials; sampling lines, filters and their compensation.",
        signature="Edges of pressure are changed, in inspiration and expiration alike.",
        confusable=("sensor_lag", "circuit_compliance"),
    )
    rank = 1
    taus = _MEMORY_TAUS

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Pressure that the sensor shows in all filters, cmH2O."""
        return self.lasting(pressure + 0.0 * flow)

    def reading(
        self, values: Values, pressure: Array, flow: Array, state: Array, length: Array
    ) -> Pair:
        """Implicit step of all filters."""
        after = self.step(state, pressure, length)
        return pressure + self.weighed(values, after - pressure), after


#: Positions in the recording where the curve bends; at the first it is zero.
_DRIFT_KNOTS = (0.0, 0.25, 0.5, 0.75, 1.0)


class DriftShape(Lines):
    """An offset of the reading; that of the first breath is zero, as PEEP absorbs it."""

    description = Description(
        name="drift_shape",
        title="measurement: any drift of the sensor's zero",
        site="sensor",
        equation="y = p + f(x), x = position of the breath in the recording, f(0) = 0",
        parameters=coefficients(
            (f"position {x:g}" for x in _DRIFT_KNOTS[1:]),
            unit="cmH2O",
            meaning="offset of the reading at",
            low=-8.0,
            high=8.0,
            spread=2.0,
        ),
        source="Straight lines between fixed knots.",
        signature="An error that is the same at all samples of a breath and differs between them.",
        confusable=("sensor_drift",),
    )
    absorbed = (0,)
    rank = 3
    knots, fixed = _DRIFT_KNOTS, _DRIFT_KNOTS[:1]
    uses_position = True

    def sensor_output(self, values: Values, pressure: Array, position: Array) -> Array:
        """Add the offset."""
        return pressure + self.curve(values, position)

    def sensor_input(self, values: Values, recorded: Array, position: Array) -> Array:
        """Take it away."""
        return recorded - self.curve(values, position)
