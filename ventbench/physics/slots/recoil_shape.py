"""f(V): any recoil of the lung."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.slots._curves import Integral
from ventbench.physics.slots._element import Element, Shape, coefficients

#: V / C at which the slope is given, cmH2O, so that they suit any lung; at the first it is zero.
_KNOTS = (0.0, 6.0, 10.0, 15.0, 21.0, 30.0, 45.0)


class RecoilShape(Element):
    """An extra recoil, whose slope over the lung's own is straight between knots.

    Curve and slope are zero at zero volume: the slope there is 1/C. What PEEP could absorb, a
    constant, is zero too.
    """

    description = Description(
        name="recoil_shape",
        title="f(V): any recoil of the lung",
        site="alveolus",
        equation="P = s + f(s), s = V / C, f(0) = df/ds(0) = 0, df/ds straight between knots",
        parameters=coefficients(
            (f"V / C = {s:g} cmH2O" for s in _KNOTS[1:]), "1",
            "elastance above 1/C, over 1/C, at", -0.9, 12.0, 1.0,
        ),
        source="Smooth curve between fixed knots; the recoil always rises with volume.",
        signature="Error that follows the volume of the lung, in inspiration and expiration alike.",
        confusable=("nonlinear_compliance",),
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the curve at the last volume."""
        extra, slope = Integral(_KNOTS)(view.elastance * view.volume, self._slopes(values))
        return network.plus(recoil=extra, elastance=slope * view.elastance)

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Recoil over volume."""
        s = np.linspace(0.0, 45.0, 181)
        extra, _ = Integral(_KNOTS)(jnp.asarray(s), self._slopes(values))
        return (
            Shape(s * base["C"], np.asarray(extra), "volume, mL", "extra recoil, cmH2O", (0, 1)),
        )

    def _slopes(self, values: Values) -> list:
        return [0.0, *self.coefficients(values)]


MECHANISM = RecoilShape()
