"""measurement: any drift of the sensor's zero in the course of a recording."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.nonparametric._curves import Hats
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Positions in the recording where the curve bends; at the first it is zero.
_KNOTS = (0.0, 0.25, 0.5, 0.75, 1.0)


class DriftShape(Element):
    """An offset of the reading; that of the first breath is zero, as PEEP absorbs it."""

    description = Description(
        name="drift_shape",
        title="measurement: any drift of the sensor's zero",
        site="sensor",
        equation="y = p + f(x), x = position of the breath in the recording, f(0) = 0",
        parameters=coefficients(
            (f"position {x:g}" for x in _KNOTS[1:]), "cmH2O", "offset of the reading at", -8.0, 8.0,
            2.0,
        ),
        source="Straight lines between fixed knots.",
        signature="An error that is the same at all samples of a breath and differs between them.",
        confusable=("sensor_drift",),
    )  # fmt: skip
    rank = 3
    positioned = True

    def shown(self, values: Values, pressure: Array, position: Array) -> Array:
        """Add the offset."""
        return pressure + self._offset(values, position)

    def meant(self, values: Values, shown: Array, position: Array) -> Array:
        """Take it away."""
        return shown - self._offset(values, position)

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Offset over the recording."""
        x = np.linspace(0.0, 1.0, 101)
        y = np.asarray(self._offset(values, jnp.asarray(x)))
        return (Shape(x, y, "position in the recording, 0..1", "offset, cmH2O", (0,)),)

    def _offset(self, values: Values, position: Array) -> Array:
        return Hats(_KNOTS)(position, [0.0, *self.coefficients(values)])


MECHANISM = DriftShape()
