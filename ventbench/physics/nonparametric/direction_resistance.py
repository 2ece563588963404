"""R(direction): another resistance outwards than inwards."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.nonparametric._element import Element, Shape, coefficients


class DirectionResistance(Element):
    """A factor of R for flow out of the lung; R itself is that of inspiration."""

    description = Description(
        name="direction_resistance",
        title="R(direction): another resistance outwards",
        site="airway",
        equation="p = ... + R Q inwards, R (1 + c) Q outwards",
        parameters=coefficients(
            ("outwards",), "1", "resistance above R, over R,", -0.8, 6.0, 1.0
        ),
        source="Airways narrow as pressure around them rises in expiration; one-way connectors.",
        signature="Expiration is slower or faster than the R of inspiration allows.",
        confusable=("exhalation_valve_delay", "turbulent_resistance"),
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Resistance in the direction of the last flow."""
        outwards = jnp.where(view.flow < 0.0, values["c1"], 0.0)
        return network.plus(resistance=view.resistance * outwards)

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Pressure drop over flow."""
        q = np.linspace(-1.5, 1.5, 301)
        y = base["R"] * float(values["c1"]) * np.minimum(q, 0.0)
        return (Shape(q, y, "flow, L/s", "extra pressure drop, cmH2O", (1,)),)


MECHANISM = DirectionResistance()
