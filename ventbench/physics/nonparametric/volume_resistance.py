"""R(V): a resistance that depends on the lung's volume."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.nonparametric._curves import Hats
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: V / C where the factor bends, cmH2O; at the first, near the end of expiration, it is 1.
_KNOTS = (5.0, 9.0, 14.0, 20.0, 30.0, 45.0)


class VolumeResistance(Element):
    """A factor of R, straight between knots; it is 1 at V / C = 5 cmH2O and below: there R is R."""

    description = Description(
        name="volume_resistance",
        title="R(V): resistance that depends on volume",
        site="airway",
        equation="p = ... + R (1 + f(V / C)) Q, f straight between knots, f(5 cmH2O) = 0",
        parameters=coefficients(
            (f"V / C = {s:g} cmH2O" for s in _KNOTS[1:]), "1", "resistance above R, over R, at",
            -0.8, 6.0, 1.0,
        ),
        source="Airways widen as the lung fills, and narrow or close as it empties.",
        signature="The drop at edges of the flow depends on the volume at which they occur.",
        confusable=("turbulent_resistance", "nonlinear_compliance"),
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Resistance at the volume that the last flow leads to."""
        filled = view.elastance * (view.volume + view.length * view.flow)
        return network.plus(resistance=view.resistance * self._excess(values, filled))

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Resistance over volume."""
        s = np.linspace(5.0, 45.0, 161)
        y = base["R"] * np.asarray(self._excess(values, jnp.asarray(s)))
        return (Shape(s * base["C"], y, "volume, mL", "extra resistance, cmH2O s/L", (0,)),)

    def _excess(self, values: Values, filled: Array) -> Array:
        return Hats(_KNOTS)(filled, [0.0, *self.coefficients(values)])


MECHANISM = VolumeResistance()
