"""f(V): any recoil of the lung."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.nonparametric._curves import Integral
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: V / C at which the slope is given, cmH2O, so that they suit any lung. Below the second it does
#: not change, as data are rare there.
_KNOTS = (0.0, 5.0, 10.0, 15.0, 21.0, 30.0, 45.0)

#: The slope at 10 cmH2O is 1 before the whole is scaled, which is to the mean with these weights.
_FREE = (5.0, 15.0, 21.0, 30.0, 45.0)
_WEIGHTS = (0.25, 0.25, 0.0, 0.0, 0.0)


class RecoilShape(Element):
    """Another recoil, whose slope over the lung's own is straight between knots.

    It is zero at zero volume, as a constant is one of PEEP and of the start, and its mean slope
    between 5 and 15 cmH2O is 1/C. So that the recoil always rises, its slope is scaled to that mean
    and not shifted: it is not quite linear in its coefficients.
    """

    description = Description(
        name="recoil_shape",
        title="f(V): any recoil of the lung",
        site="alveolus",
        equation=(
            "P = integral of (1 + g(s)) / (1 + mean of g) ds up to s = V / C, "
            "g straight between knots, g(10 cmH2O) = 0"
        ),
        parameters=coefficients(
            (f"V / C = {s:g} cmH2O" for s in _FREE), "1", "share by which the slope is higher at",
            -0.9, 12.0, 1.0,
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

    def _slopes(self, values: Values) -> list[Array]:
        """Those of the recoil less that of a linear lung, at the knots."""
        free = self.coefficients(values)
        mean = sum((w * c for w, c in zip(_WEIGHTS, free, strict=True)), 0.0 * free[0])
        low, *high = ((c - mean) / (1.0 + mean) for c in free)
        return [low, low, -mean / (1.0 + mean), *high]


MECHANISM = RecoilShape()
