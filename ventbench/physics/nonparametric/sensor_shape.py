"""measurement: any static curve of the pressure sensor."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.nonparametric._curves import Hats
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Pressures where the curve bends, cmH2O.
_KNOTS = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0)

#: Those at which it is zero.
_FIXED = (5.0, 20.0)

#: Steps of the search for the pressure of a reading, and the least slope it reckons with.
_STEPS, _LEAST = 6, 0.2


class SensorShape(Element):
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
            (f"{p:g} cmH2O" for p in _KNOTS if p not in _FIXED), "cmH2O", "error of the reading at",
            -4.0, 4.0, 1.5,
        ),
        source="Straight lines between fixed knots; sensors that saturate, tables of calibration.",
        signature="Error that follows the pressure itself, whatever the flow is.",
        confusable=("nonlinear_compliance", "leak"),
    )  # fmt: skip
    rank = 2

    def shown(self, values: Values, pressure: Array, position: Array) -> Array:
        """Add the error."""
        return pressure + self._curve(pressure, values)

    def meant(self, values: Values, shown: Array, position: Array) -> Array:
        """Pressure of a reading, by Newton's method."""
        at = self._at(values)

        def nearer(pressure: Array, _: None) -> tuple[Array, None]:
            slope = jnp.maximum(1.0 + Hats(_KNOTS).slope(pressure, at), _LEAST)
            return pressure - (pressure + Hats(_KNOTS)(pressure, at) - shown) / slope, None

        first = shown + sum(0.0 * x for x in at)  # in the shape that the steps have
        return jax.lax.scan(nearer, first, None, length=_STEPS)[0]

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Error over pressure."""
        p = np.linspace(0.0, 45.0, 181)
        y = np.asarray(self._curve(jnp.asarray(p), values))
        return (Shape(p, y, "airway pressure, cmH2O", "error of the reading, cmH2O", (0, 1)),)

    def _curve(self, pressure: Array, values: Values) -> Array:
        return Hats(_KNOTS)(pressure, self._at(values))

    def _at(self, values: Values) -> list:
        free = iter(self.coefficients(values))
        return [0.0 if p in _FIXED else next(free) for p in _KNOTS]


MECHANISM = SensorShape()
