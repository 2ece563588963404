"""f(p): any outflow beside the lung that depends on the airway's pressure."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.nonparametric._curves import Integral
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Pressures at which the slope is given, cmH2O.
_KNOTS = (0.0, 6.0, 12.0, 20.0, 30.0, 45.0)


class LeakShape(Element):
    """A flow out of the airway, whose slope is straight between knots.

    It is zero without pressure. Nothing is left out for R and C: they absorb most of a leak, but no
    curve of it exactly.
    """

    description = Description(
        name="leak_shape",
        title="f(p): any leak at the airway",
        site="circuit",
        equation="q_leak = f(p), f(0) = 0, df/dp straight between knots",
        parameters=coefficients(
            (f"{p:g} cmH2O" for p in _KNOTS), "mL/s per cmH2O", "slope of the leak at", -4.0, 60.0,
            10.0,
        ),
        source="Smooth curve between fixed knots.",
        signature="Gas that is missing, the more the higher the pressure at the airway.",
        confusable=("leak", "viscoelasticity"),
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the curve at the last pressure."""
        flow, slope = Integral(_KNOTS)(view.pressure, self.coefficients(values))
        return network.plus(leak=1e-3 * slope, leak_flow=1e-3 * (flow - slope * view.pressure))

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Outflow over pressure."""
        p = np.linspace(0.0, 50.0, 201)
        flow, _ = Integral(_KNOTS)(jnp.asarray(p), self.coefficients(values))
        return (Shape(p, np.asarray(flow), "airway pressure, cmH2O", "extra outflow, mL/s"),)


MECHANISM = LeakShape()
