"""f(Q): any pressure drop along the airway that depends on flow."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.nonparametric._curves import Integral
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Sizes of flow at which the slope is given, L/s; at the first it is zero.
_KNOTS = (0.0, 0.2, 0.6, 1.4)


class FlowShape(Element):
    """An extra pressure drop, inwards and outwards apart, whose slope is straight between knots.

    Curve and slope are zero without flow: the slope there is R.
    """

    description = Description(
        name="flow_shape",
        title="f(Q): any pressure drop of the airway",
        site="airway",
        equation="p = ... + R Q + f(Q), f(0) = df/dQ(0) = 0, df/dQ straight between knots",
        parameters=coefficients(
            (f"{side} {q:g} L/s" for side in ("inwards", "outwards") for q in _KNOTS[1:]),
            "cmH2O s/L", "resistance above R at", -15.0, 120.0, 20.0, follows="R",
        ),
        source="Smooth curve between fixed knots.",
        signature="Error that follows the flow into and out of the lung, at any volume.",
        confusable=("turbulent_resistance", "valve_curve"),
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the curve at the last flow."""
        drop, slope = self._drop(values, view.flow)
        return network.plus(resistance=slope, recoil=drop - slope * view.flow)

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Pressure drop over flow."""
        q = np.linspace(-1.5, 1.5, 301)
        drop, _ = self._drop(values, jnp.asarray(q))
        return (Shape(q, np.asarray(drop), "flow, L/s", "extra pressure drop, cmH2O", (1,)),)

    def _drop(self, values: Values, flow: Array) -> tuple[Array, Array]:
        c = self.coefficients(values)
        inwards, steeper_in = Integral(_KNOTS)(jnp.maximum(flow, 0.0), [0.0, *c[:3]])
        outwards, steeper_out = Integral(_KNOTS)(jnp.maximum(-flow, 0.0), [0.0, *c[3:]])
        return inwards - outwards, steeper_in + steeper_out


MECHANISM = FlowShape()
