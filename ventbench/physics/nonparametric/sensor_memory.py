"""measurement: any linear memory of the pressure sensor."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.nonparametric._curves import beside
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Time constants, s.
_TAUS = (0.02, 0.08, 0.3)


class SensorMemory(Element):
    """A bank of first-order filters on the reading; a lasting pressure is shown as it is."""

    description = Description(
        name="sensor_memory",
        title="measurement: any linear memory of the pressure sensor",
        site="sensor",
        equation="y = p + sum_k c_k (s_k - p), tau_k ds_k/dt = p - s_k",
        parameters=coefficients(
            (f"{1e3 * tau:g} ms" for tau in _TAUS), "1", "share of the reading that comes late by",
            -3.0, 3.0, 1.0,
        ),
        source="Sum of fixed exponentials; sampling lines, filters and their compensation.",
        signature="Edges of pressure are changed, in inspiration and expiration alike.",
        confusable=("sensor_lag", "circuit_compliance"),
    )  # fmt: skip
    rank = 1
    stateful = True

    def rest(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Pressure that the sensor shows in all filters, cmH2O."""
        return jnp.stack([pressure + 0.0 * flow] * len(_TAUS))

    def reading(
        self, values: Values, pressure: Array, state: Array, length: Array
    ) -> tuple[Array, Array]:
        """Implicit step of all filters."""
        taus = beside(_TAUS, state)
        after = (taus * state + length * pressure) / (taus + length)
        late = jnp.sum(self.stacked(values, state) * (after - pressure), axis=0)
        return pressure + late, after

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Error of the reading after a step of the pressure."""
        t = np.linspace(0.0, 1.0, 401)
        late = self.fading(values, _TAUS, t)
        unit = "error after a step of 10 cmH2O, cmH2O"
        return (Shape(t, -10.0 * late, "time after a step, s", unit),)


MECHANISM = SensorMemory()
