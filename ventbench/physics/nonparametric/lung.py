"""The lung: a leak, a pressure drop and factors of its resistance, recoil and relaxing stresses."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Network, Values, View
from ventbench.physics.nonparametric import (
    BasisTerm,
    FilterBank,
    Lines,
    PiecewiseQuadratic,
    coefficients,
    per_state,
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

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the curve at the last pressure."""
        flow, slope = PiecewiseQuadratic(_LEAK_KNOTS)(view.pressure, self.coefficients(values))
        return network.plus(leak=1e-3 * slope, leak_flow=1e-3 * (flow - slope * view.pressure))


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
    absorbed = (1,)

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the curve at the last flow."""
        c, flow, curve = self.coefficients(values), view.flow, PiecewiseQuadratic(_FLOW_KNOTS)
        inwards, steeper_in = curve(jnp.maximum(flow, 0.0), [0.0, *c[:3]])
        outwards, steeper_out = curve(jnp.maximum(-flow, 0.0), [0.0, *c[3:]])
        slope = steeper_in + steeper_out
        return network.plus(resistance=slope, recoil=inwards - outwards - slope * flow)


#: V / C where the factor bends, cmH2O; at the first, near the end of expiration, it is 1.
_VOLUME_KNOTS = (5.0, 9.0, 14.0, 20.0, 30.0, 45.0)


class VolumeResistance(Lines):
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
    absorbed = (0,)
    knots, fixed = _VOLUME_KNOTS, _VOLUME_KNOTS[:1]

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Resistance at the volume that the last flow leads to."""
        filled = view.elastance * (view.volume + view.length * view.flow)
        return network.plus(resistance=view.resistance * self.curve(values, filled))


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
    absorbed = (1,)

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Resistance in the direction of the last flow."""
        outwards = jnp.where(view.flow < 0.0, values["c1"], 0.0)
        return network.plus(resistance=view.resistance * outwards)


#: V / C at which the slope is given, cmH2O, so that they suit any lung. Below the second it does
#: not change, as data are rare there.
_RECOIL_KNOTS = (0.0, 5.0, 10.0, 15.0, 21.0, 30.0, 45.0)

#: The slope at 10 cmH2O is 1 before the whole is scaled, which is to the mean with these weights.
_RECOIL_FREE = (5.0, 15.0, 21.0, 30.0, 45.0)
_RECOIL_WEIGHTS = (0.25, 0.25, 0.0, 0.0, 0.0)


class RecoilShape(BasisTerm):
    """Another recoil, whose slope over the lung's own is straight between knots.

    It is zero at zero volume, as a constant is one of PEEP and of the start, and its mean slope
    between 5 and 15 cmH2O is 1/C. So that the recoil always rises, its slope is scaled to that mean
    and not shifted: it is not quite linear in its coefficients.
    """

    description = Description(
        name="recoil_shape",
        title="f(V): any recoil of the lung",
        site="alveolus",
        equation="P = integral of (1 + g(s)) / (1 + mean of g) ds up to s = V / C, g straight "
        "between knots, g(10 cmH2O) = 0",
        parameters=coefficients(
            (f"V / C = {s:g} cmH2O" for s in _RECOIL_FREE),
            unit="1",
            meaning="share by which the slope is higher at",
            low=-0.9,
            high=12.0,
            spread=1.0,
        ),
        source="Smooth curve between fixed knots; the recoil always rises with volume.",
        signature="Error that follows the volume of the lung, in inspiration and expiration alike.",
        confusable=("nonlinear_compliance",),
    )
    absorbed = (0, 1)

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the curve at the last volume."""
        extra, slope = PiecewiseQuadratic(_RECOIL_KNOTS)(
            view.elastance * view.volume, self._slopes(values)
        )
        return network.plus(recoil=extra, elastance=slope * view.elastance)

    def _slopes(self, values: Values) -> list[Array]:
        """Slopes of the recoil less that of a linear lung, at the knots."""
        free = self.coefficients(values)
        mean = sum((w * c for w, c in zip(_RECOIL_WEIGHTS, free, strict=True)), 0.0 * free[0])
        low, *high = ((c - mean) / (1.0 + mean) for c in free)
        return [low, low, -mean / (1.0 + mean), *high]


#: Relaxation times, s.
_MEMORY_TAUS = (0.05, 0.2, 0.7, 2.5)


class RecoilMemory(FilterBank):
    """Maxwell elements beside the elastance, with fixed times.

    One that is much faster than a sample would be resistance, one slower than a breath compliance:
    R and C absorb the most part of the first and of the last.
    """

    description = Description(
        name="recoil_memory",
        title="memory of p: any spectrum of relaxation",
        site="alveolus",
        equation="P = V / C + sum_k S_k, dS_k/dt = c_k / C Q - S_k / tau_k",
        parameters=coefficients(
            (f"{tau:g} s" for tau in _MEMORY_TAUS),
            unit="1",
            meaning="elastance over that of the lung that relaxes within",
            low=-0.24,
            high=3.0,
            spread=0.5,
        ),
        source="Sum of fixed exponentials (generalised Maxwell body).",
        signature="Pressure creeps while volume is held, and lags behind slow changes.",
        confusable=("viscoelasticity", "leak"),
    )
    taus = _MEMORY_TAUS

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """No stress, cmH2O."""
        return self.lasting(0.0 * (flow + pressure))

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Stresses after the step: what is left of them, and what the flow adds."""
        decay = 1.0 / (1.0 + view.length / per_state(_MEMORY_TAUS, view.state))
        added = jnp.sum(self.stacked(values, view.state) * decay, axis=0)
        return network.plus(
            recoil=jnp.sum(view.state * decay, axis=0), elastance=view.elastance * added
        )

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Stresses, cmH2O."""
        gained = self.stacked(values, state) * (view.length * view.elastance * flow)
        return (state + gained) / (1.0 + view.length / per_state(_MEMORY_TAUS, state))
