"""Terms of the gas supply: its answer to the flow that was drawn from it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.nonparametric.basis import Curve, FilterBank, coefficients

#: Time constants, s, and the flow whose effect the coefficients are, L/s.
_TAUS = (0.3, 1.0, 3.0)
_FLOW = 0.5


class SupplyMemory(FilterBank):
    """A factor of the flow that depends on the flow before; to first order, any such factor."""

    description = Description(
        name="supply_memory",
        title="memory of u: a factor by recent flow",
        site="supply",
        equation="q = q_valve (1 + sum_k c_k s_k / (0.5 L/s)), tau_k ds_k/dt = q_valve - s_k",
        parameters=coefficients(
            (f"{tau:g} s" for tau in _TAUS),
            unit="1",
            meaning="share of the flow that is gained at a lasting 0.5 L/s, with the time constant",
            low=-0.6,
            high=0.6,
            spread=0.3,
        ),
        source="Second-order term of a Volterra series, with fixed exponentials.",
        signature="Flow is lost late in inspiration and in big breaths; after a pause it is back.",
        confusable=("supply_droop", "valve_curve"),
    )
    rank = 3
    taus = _TAUS

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """The resting flow in all filters, L/s."""
        return self.lasting(flow + 0.0 * pressure)

    def inflow(
        self, values: Values, flow: Array, state: Array, length: Array
    ) -> tuple[Array, Array]:
        """Implicit step of all filters."""
        after = self.step(state, flow, length)
        return flow * (1.0 + self.weighed(values, after) / _FLOW), after

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Flow at a constant command, over time."""
        t = np.linspace(0.0, 2.0, 401)
        y = self.decay(values, np.zeros(1)) - self.decay(values, t)
        return (Curve(t, y, "time since 0.5 L/s began, s", "flow that is gained, share", (0,)),)


#: Basis terms of this module.
MECHANISMS = (SupplyMemory(),)
