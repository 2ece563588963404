"""memory of u: any linear memory of what the valve was asked for."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.nonparametric._curves import beside
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Time constants, s.
_TAUS = (0.02, 0.06, 0.2, 0.7)


class CommandMemory(Element):
    """A bank of first-order filters on the flow of the valve.

    A lasting flow is passed as it is: its factor is the gain. A dead time is met in part only.
    """

    description = Description(
        name="command_memory",
        title="memory of u: any linear memory of the valve",
        site="inspiratory valve",
        equation="q = q_asked + sum_k c_k (s_k - q_asked), tau_k ds_k/dt = q_asked - s_k",
        parameters=coefficients(
            (f"{1e3 * tau:g} ms" for tau in _TAUS), "1", "share of the flow that comes late by",
            [-6.0, -6.0, -3.0, -3.0], [6.0, 6.0, 3.0, 3.0], [2.0, 2.0, 1.0, 1.0],
        ),
        source="Sum of fixed exponentials; close to any lag, rise or sag that is linear.",
        signature="Error that follows what the command was some time ago.",
        confusable=("valve_lag", "valve_delay", "supply_droop", "valve_hysteresis"),
    )  # fmt: skip
    rank = 2
    stateful = True

    def rest(self, values: Values, flow: Array, pressure: Array) -> Array:
        """The resting flow in all filters, L/s."""
        return jnp.stack([flow + 0.0 * pressure] * len(_TAUS))

    def inflow(
        self, values: Values, flow: Array, state: Array, length: Array
    ) -> tuple[Array, Array]:
        """Implicit step of all filters."""
        taus = beside(_TAUS, state)
        after = (taus * state + length * flow) / (taus + length)
        return flow + jnp.sum(self.stacked(values, state) * (after - flow), axis=0), after

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Answer of the flow to a step of the command."""
        t = np.linspace(0.0, 2.0, 401)
        late = self.fading(values, _TAUS, t)
        return (Shape(t, -late, "time after a step, s", "flow that is missing (-), share"),)


MECHANISM = CommandMemory()
