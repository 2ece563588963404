"""Flow and pressure at the airway: a leak, a pressure drop, and factors of its resistance."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import PneumaticNetwork, View
from ventbench.physics.nonparametric.basis import (
    BasisTerm,
    Curve,
    PiecewiseLinear,
    PiecewiseQuadratic,
    coefficients,
)

#: Pressures at which the slope is given, cmH2O.
_LEAK_KNOTS = (0.0, 6.0, 12.0, 20.0, 30.0, 45.0)


class LeakShape(BasisTerm):
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
            (f"{p:g} cmH2O" for p in _LEAK_KNOTS),
            unit="mL/s per cmH2O",
            meaning="slope of the leak at",
            low=-4.0,
            high=60.0,
            spread=10.0,
        ),
        source="Smooth curve between fixed knots.",
        signature="Gas that is missing, the more the higher the pressure at the airway.",
        confusable=("leak", "viscoelasticity"),
    )

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Tangent of the curve at the last pressure."""
        flow, slope = PiecewiseQuadratic(_LEAK_KNOTS)(view.pressure, self.coefficients(values))
        return network.plus(leak=1e-3 * slope, leak_flow=1e-3 * (flow - slope * view.pressure))

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Outflow over pressure."""
        p = np.linspace(0.0, 50.0, 201)
        flow, _ = PiecewiseQuadratic(_LEAK_KNOTS)(jnp.asarray(p), self.coefficients(values))
        return (Curve(p, np.asarray(flow), "airway pressure, cmH2O", "extra outflow, mL/s"),)


#: Sizes of flow at which the slope is given, L/s; at the first it is zero.
_FLOW_KNOTS = (0.0, 0.2, 0.6, 1.4)


class FlowShape(BasisTerm):
    """An extra pressure drop, inwards and outwards apart, whose slope is straight between knots.

    Curve and slope are zero without flow: the slope there is R.
    """

    description = Description(
        name="flow_shape",
        title="f(Q): any pressure drop of the airway",
        site="airway",
        equation="p = ... + R Q + f(Q), f(0) = df/dQ(0) = 0, df/dQ straight between knots",
        parameters=coefficients(
            (f"{side} {q:g} L/s" for side in ("inwards", "outwards") for q in _FLOW_KNOTS[1:]),
            unit="cmH2O/(L/s)",
            meaning="resistance above R at",
            low=-15.0,
            high=120.0,
            spread=20.0,
            follows="R",
        ),
        source="Smooth curve between fixed knots.",
        signature="Error that follows the flow into and out of the lung, at any volume.",
        confusable=("turbulent_resistance", "valve_curve"),
    )

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Tangent of the curve at the last flow."""
        drop, slope = self._drop(values, view.flow)
        return network.plus(resistance=slope, recoil=drop - slope * view.flow)

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Pressure drop over flow."""
        q = np.linspace(-1.5, 1.5, 301)
        drop, _ = self._drop(values, jnp.asarray(q))
        return (Curve(q, np.asarray(drop), "flow, L/s", "extra pressure drop, cmH2O", (1,)),)

    def _drop(self, values: Values, flow: Array) -> tuple[Array, Array]:
        c = self.coefficients(values)
        inwards, steeper_in = PiecewiseQuadratic(_FLOW_KNOTS)(jnp.maximum(flow, 0.0), [0.0, *c[:3]])
        outwards, steeper_out = PiecewiseQuadratic(_FLOW_KNOTS)(
            jnp.maximum(-flow, 0.0), [0.0, *c[3:]]
        )
        return inwards - outwards, steeper_in + steeper_out


#: V / C where the factor bends, cmH2O; at the first, near the end of expiration, it is 1.
_VOLUME_KNOTS = (5.0, 9.0, 14.0, 20.0, 30.0, 45.0)


class VolumeResistance(BasisTerm):
    """A factor of R, straight between knots; it is 1 at V / C = 5 cmH2O and below: there R is R."""

    description = Description(
        name="volume_resistance",
        title="R(V): resistance that depends on volume",
        site="airway",
        equation="p = ... + R (1 + f(V / C)) Q, f straight between knots, f(5 cmH2O) = 0",
        parameters=coefficients(
            (f"V / C = {s:g} cmH2O" for s in _VOLUME_KNOTS[1:]),
            unit="1",
            meaning="resistance above R, over R, at",
            low=-0.8,
            high=6.0,
            spread=1.0,
        ),
        source="Airways widen as the lung fills, and narrow or close as it empties.",
        signature="The drop at edges of the flow depends on the volume at which they occur.",
        confusable=("turbulent_resistance", "nonlinear_compliance"),
    )

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Resistance at the volume that the last flow leads to."""
        filled = view.elastance * (view.volume + view.length * view.flow)
        return network.plus(resistance=view.resistance * self._excess(values, filled))

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Resistance over volume."""
        s = np.linspace(5.0, 45.0, 161)
        y = base["R"] * np.asarray(self._excess(values, jnp.asarray(s)))
        return (Curve(s * base["C"], y, "volume, mL", "extra resistance, cmH2O/(L/s)", (0,)),)

    def _excess(self, values: Values, filled: Array) -> Array:
        return PiecewiseLinear(_VOLUME_KNOTS)(filled, [0.0, *self.coefficients(values)])


class DirectionResistance(BasisTerm):
    """A factor of R for flow out of the lung; R itself is that of inspiration."""

    description = Description(
        name="direction_resistance",
        title="R(direction): another resistance outwards",
        site="airway",
        equation="p = ... + R Q inwards, R (1 + c) Q outwards",
        parameters=coefficients(
            ("outwards",),
            unit="1",
            meaning="resistance above R, over R,",
            low=-0.8,
            high=6.0,
            spread=1.0,
        ),
        source="Airways narrow as pressure around them rises in expiration; one-way connectors.",
        signature="Expiration is slower or faster than the R of inspiration allows.",
        confusable=("exhalation_valve_delay", "turbulent_resistance"),
    )

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Resistance in the direction of the last flow."""
        outwards = jnp.where(view.flow < 0.0, values["c1"], 0.0)
        return network.plus(resistance=view.resistance * outwards)

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Pressure drop over flow."""
        q = np.linspace(-1.5, 1.5, 301)
        y = base["R"] * float(values["c1"]) * np.minimum(q, 0.0)
        return (Curve(q, y, "flow, L/s", "extra pressure drop, cmH2O", (1,)),)


#: Basis terms of this module.
MECHANISMS = (
    LeakShape(),
    FlowShape(),
    VolumeResistance(),
    DirectionResistance(),
)
