"""exhalation path: any opening of the expiratory valve over time."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.nonparametric._curves import beside
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Time constants of the opening, s.
_TAUS = (0.015, 0.04, 0.12)


class OutletMemory(Element):
    """A bank of first-order filters on the opening of the valve, which closes promptly.

    A conductance below zero is zero, so that an answer that overshoots downwards is a dead time.
    """

    description = Description(
        name="outlet_memory",
        title="exhalation path: any slow opening of the expiratory valve",
        site="expiratory valve",
        equation=(
            "q_out = o (p - PEEP) / R_ex, o = max(0, u_out + sum_k c_k (s_k - u_out)), "
            "tau_k ds_k/dt = u_out - s_k"
        ),
        parameters=coefficients(
            (f"{1e3 * tau:g} ms" for tau in _TAUS), "1", "share of the opening that comes late by",
            -1.0, 12.0, 2.0, scan=(0.0, 4.0, 10.0),
        ),
        source="Sum of fixed exponentials.",
        signature="Error at the start of expiration, whatever the inspiration was.",
        confusable=("exhalation_valve_delay", "inertance"),
    )  # fmt: skip
    stateful = True

    def rest(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Open."""
        return jnp.stack([1.0 + 0.0 * (flow + pressure)] * len(_TAUS))

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Opening at the end of the step."""
        states = self.settle(values, view.state, view.flow, view)
        late = jnp.sum(self.stacked(values, states) * (states - view.opened), axis=0)
        opened = jnp.maximum(view.opened + late, 0.0)
        return network.plus(outlet=view.outlet * (opened - view.opened))

    def settle(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """How far filters of the command are open, 0..1; they close at once."""
        taus = beside(_TAUS, state)
        after = (taus * state + view.length * view.opened) / (taus + view.length)
        return jnp.minimum(after, view.opened)

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Opening over time."""
        t = np.linspace(0.0, 0.5, 251)
        shut = np.minimum(self.fading(values, _TAUS, t), 1.0)
        return (Shape(t, shut, "time after the command to open, s", "share that is still shut"),)


MECHANISM = OutletMemory()
