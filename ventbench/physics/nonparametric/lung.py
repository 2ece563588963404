"""Recoil of the lung: a curve over volume, and relaxing stresses."""

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
    FilterBank,
    PiecewiseQuadratic,
    coefficients,
    per_state,
)

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
        equation=(
            "P = integral of (1 + g(s)) / (1 + mean of g) ds up to s = V / C, "
            "g straight between knots, g(10 cmH2O) = 0"
        ),
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

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Tangent of the curve at the last volume."""
        extra, slope = PiecewiseQuadratic(_RECOIL_KNOTS)(
            view.elastance * view.volume, self._slopes(values)
        )
        return network.plus(recoil=extra, elastance=slope * view.elastance)

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Recoil over volume."""
        s = np.linspace(0.0, 45.0, 181)
        extra, _ = PiecewiseQuadratic(_RECOIL_KNOTS)(jnp.asarray(s), self._slopes(values))
        return (
            Curve(s * base["C"], np.asarray(extra), "volume, mL", "extra recoil, cmH2O", (0, 1)),
        )

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

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Stresses after the step: what is left of them, and what the flow adds."""
        left = 1.0 / (1.0 + view.length / per_state(_MEMORY_TAUS, view.state))
        added = jnp.sum(self.stacked(values, view.state) * left, axis=0)
        return network.plus(
            recoil=jnp.sum(view.state * left, axis=0), elastance=view.elastance * added
        )

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Stresses, cmH2O."""
        gained = self.stacked(values, state) * (view.length * view.elastance * flow)
        return (state + gained) / (1.0 + view.length / per_state(_MEMORY_TAUS, state))

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Stress after a volume that would raise a linear lung by 10 cmH2O."""
        t = np.linspace(0.0, 5.0, 501)
        stress = 10.0 * self.decay(values, t)
        unit = "stress after a step of 10 cmH2O x C, cmH2O"
        return (Curve(t, stress, "time after a step, s", unit, (0,)),)


#: Basis terms of this module.
MECHANISMS = (
    RecoilShape(),
    RecoilMemory(),
)
