"""The pressure sensor is bent: right at both ends of its range, wrong between them."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Parameter, Values

#: Pressure at which the bent curve meets the straight one again, cmH2O.
SPAN = 40.0

#: Distance from either end of the span up to which the parabola is followed, cmH2O.
_BEYOND = 20.0

#: Least slope of the curve, which must rise everywhere; pressures beyond follow the tangent.
_LEAST_SLOPE = 0.2


class SensorCurve(Mechanism):
    """A parabola on top of the true pressure."""

    description = Description(
        name="sensor_curve", title="bent characteristic of the pressure sensor", site="sensor",
        equation="y = p + 4 bend p / 40 (1 - p / 40)",
        parameters=(
            Parameter("bend", "cmH2O",
                      "error at 20 cmH2O of a sensor that is right at 0 and at 40 cmH2O",
                      -6.0, 6.0, 0.0, 0.9, 1.4),
        ),
        source="Terminal-base nonlinearity of piezoresistive sensors: 0.1 to 1 % of full scale if "
        "compensated, several percent if not.",
        signature="An error by pressure alone, in inspiration and expiration alike, whatever flow "
        "and volume are.",
        confusable=("nonlinear_compliance", "supply_pressure"), least=0.25,
        least_reason="half a percent of a usual sensor's full scale",
        special_case_of=("sensor_shape",),
    )  # fmt: skip

    def sensor_output(self, values: Values, pressure: Array, position: Array) -> Array:
        """Bent pressure."""
        steepness = 4.0 * values["bend"] / SPAN
        # The parabola where it rises and pressures are usual, its tangent beyond.
        low, high = _rising(steepness)
        inside = jnp.clip(pressure, low, high)
        slope = 1.0 + steepness * (1.0 - 2.0 * inside / SPAN)
        return inside + steepness * inside * (1.0 - inside / SPAN) + slope * (pressure - inside)

    def sensor_input(self, values: Values, shown: Array, position: Array) -> Array:
        """True pressure of a reading, by Newton's method, which the tangents make safe."""
        steepness = 4.0 * values["bend"] / SPAN
        low, high = _rising(steepness)
        pressure = shown
        for _ in range(8):
            inside = jnp.clip(pressure, low, high)
            slope = 1.0 + steepness * (1.0 - 2.0 * inside / SPAN)
            off = self.sensor_output(values, pressure, position) - shown
            pressure = pressure - off / slope
        return pressure


def _rising(steepness: Array) -> tuple[Array, Array]:
    """Ends of the pressures at which the parabola is steep enough, cmH2O."""
    # Slope 1 + s (1 - 2 p / 40) = least at p = 20 (1 + (1 - least) / s).
    size = jnp.maximum(jnp.abs(steepness), 1e-6)
    reach = 0.5 * SPAN * (1.0 - _LEAST_SLOPE) / size
    middle = 0.5 * SPAN
    low = jnp.where(steepness < 0, jnp.maximum(middle - reach, -_BEYOND), -_BEYOND)
    high = jnp.where(steepness > 0, jnp.minimum(middle + reach, SPAN + _BEYOND), SPAN + _BEYOND)
    return low, high
