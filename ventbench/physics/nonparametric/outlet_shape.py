"""exhalation path: any conductance of the expiratory valve."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.nonparametric._curves import Hats
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: p - PEEP where the factor bends, cmH2O; where it is 1, the conductance is 1 / R_ex.
_KNOTS = (0.0, 2.0, 5.0, 10.0, 20.0)
_FIXED = 5.0
_FREE = tuple(d for d in _KNOTS if d != _FIXED)


class OutletShape(Element):
    """A factor of the open valve's conductance, by the pressure across it.

    The factor is 1 at 5 cmH2O above PEEP: there R_ex is R_ex.
    """

    description = Description(
        name="outlet_shape",
        title="exhalation path: any conductance of the expiratory valve",
        site="expiratory valve",
        equation=(
            "q_out = o (1 + f(p - PEEP)) (p - PEEP) / R_ex, o how far it is open, f straight "
            "between knots, f(5 cmH2O) = 0"
        ),
        parameters=coefficients(
            (f"p - PEEP = {d:g} cmH2O" for d in _FREE), "1",
            "conductance above 1 / R_ex, times R_ex, at", -0.9, 6.0, 1.0,
        ),
        source="Straight lines between fixed knots, as of a diaphragm on a spring.",
        signature="Error during expiration only, whatever the inspiration was.",
        confusable=("exhalation_valve_delay", "inertance"),
    )  # fmt: skip
    rank = 1  # a factor of how far the valve is open, however late that is

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Conductance at the last pressure."""
        excess = self._excess(values, view.pressure - view.peep)
        return network.plus(outlet=network.outlet * excess)

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Conductance over pressure."""
        d = np.linspace(0.0, 30.0, 121)
        y = 1e3 / base["R_ex"] * np.asarray(self._excess(values, jnp.asarray(d)))
        return (Shape(d, y, "p - PEEP, cmH2O", "extra conductance, mL/s per cmH2O", (0,)),)

    def _excess(self, values: Values, above: Array) -> Array:
        free = iter(self.coefficients(values))
        return Hats(_KNOTS)(above, [0.0 if d == _FIXED else next(free) for d in _KNOTS])


MECHANISM = OutletShape()
