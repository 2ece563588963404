"""f(u): any curve of the inspiratory valve."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.nonparametric._curves import Hats
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Commands where the curve bends, %; at the fourth it is zero. Closest where valves begin to open.
_KNOTS = (0.0, 1.0, 3.0, 6.0, 12.0, 20.0, 35.0, 60.0, 100.0)

#: The knot at which the curve is zero: what is left there is the valve's gain.
_FIXED = 20.0
_FREE = tuple(u for u in _KNOTS[1:] if u != _FIXED)


class ValveShape(Element):
    """A change of the effective command, which keeps it within 0..2 u.

    It is zero at 0 and at 20 %, as a common factor of all flows is the valve's gain, or, from
    pressure alone, a common scale of R, 1/C and R_ex. If no command gets near 20 %, that scale is
    not held, and only the prior keeps it.
    """

    description = Description(
        name="valve_shape",
        title="f(u): any curve of the inspiratory valve",
        site="inspiratory valve",
        equation="q = gain (u + f(u)), f straight between knots, f(0) = f(20 %) = 0",
        parameters=coefficients(
            (f"{u:g} %" for u in _FREE),
            "%",
            "change of the effective command at",
            [-u for u in _FREE],
            _FREE,
            [0.5 * u for u in _FREE],
        ),
        source="Straight lines between fixed knots; each effective command stays positive.",
        signature="Error that follows the command, whatever flow and pressure are.",
        confusable=("valve_curve", "valve_dead_band", "command_rounding"),
    )
    rank = 5

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Add the curve."""
        return u_in + self._change(values, u_in), memory

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Change of the flow over the command."""
        u = np.linspace(0.0, 100.0, 401)
        y = base["gain"] * np.asarray(self._change(values, jnp.asarray(u)))
        return (Shape(u, y, "command, %", "extra flow, mL/s", (1,)),)

    def _change(self, values: Values, u: Array) -> Array:
        free = iter(self.coefficients(values))
        return Hats(_KNOTS)(u, [0.0 if x in (0.0, _FIXED) else next(free) for x in _KNOTS])


MECHANISM = ValveShape()
