"""memory of p: any spectrum of relaxing stresses in the tissue."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.nonparametric._curves import beside
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Relaxation times, s.
_TAUS = (0.05, 0.2, 0.7, 2.5)


class RecoilMemory(Element):
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
            (f"{tau:g} s" for tau in _TAUS), "1",
            "elastance over that of the lung that relaxes within", -0.24, 3.0, 0.5,
        ),
        source="Sum of fixed exponentials (generalised Maxwell body).",
        signature="Pressure creeps while volume is held, and lags behind slow changes.",
        confusable=("viscoelasticity", "leak"),
    )  # fmt: skip
    stateful = True

    def rest(self, values: Values, flow: Array, pressure: Array) -> Array:
        """No stress, cmH2O."""
        return jnp.stack([0.0 * (flow + pressure)] * len(_TAUS))

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Stresses after the step: what is left of them, and what the flow adds."""
        left = 1.0 / (1.0 + view.length / beside(_TAUS, view.state))
        added = jnp.sum(self.stacked(values, view.state) * left, axis=0)
        return network.plus(
            recoil=jnp.sum(view.state * left, axis=0), elastance=view.elastance * added
        )

    def settle(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """Stresses, cmH2O."""
        gained = self.stacked(values, state) * (view.length * view.elastance * flow)
        return (state + gained) / (1.0 + view.length / beside(_TAUS, state))

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Stress after a volume that would raise a linear lung by 10 cmH2O."""
        t = np.linspace(0.0, 5.0, 501)
        stress = 10.0 * self.fading(values, _TAUS, t)
        unit = "stress after a step of 10 cmH2O x C, cmH2O"
        return (Shape(t, stress, "time after a step, s", unit, (0,)),)


MECHANISM = RecoilMemory()
