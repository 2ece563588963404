"""The expiratory valve: a curve of its conductance, and slow opening."""

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
    PiecewiseLinear,
    coefficients,
)

#: p - PEEP where the factor bends, cmH2O; where it is 1, the conductance is 1 / R_ex.
_OUTLET_KNOTS = (0.0, 2.0, 5.0, 10.0, 20.0)
_OUTLET_FIXED = 5.0
_OUTLET_FREE = tuple(d for d in _OUTLET_KNOTS if d != _OUTLET_FIXED)


class OutletShape(BasisTerm):
    """A factor of the open valve's conductance, by the pressure across it.

    The factor is 1 at 5 cmH2O above PEEP: there R_ex is R_ex.
    """

    description = Description(
        name="outlet_shape",
        title="exhalation path: any conductance of the expiratory valve",
        site="expiratory valve",
        equation=(
            "q_out = o (1 + f(p - PEEP)) (p - PEEP) / R_ex, o how far it is open, f straight "
            "between knots, f(5 cmH2O) = 0"
        ),
        parameters=coefficients(
            (f"p - PEEP = {d:g} cmH2O" for d in _OUTLET_FREE),
            unit="1",
            meaning="conductance above 1 / R_ex, times R_ex, at",
            low=-0.9,
            high=6.0,
            spread=1.0,
        ),
        source="Straight lines between fixed knots, as of a diaphragm on a spring.",
        signature="Error during expiration only, whatever the inspiration was.",
        confusable=("exhalation_valve_delay", "inertance"),
    )
    rank = 1  # a factor of how far the valve is open, however late that is

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Conductance at the last pressure."""
        excess = self._excess(values, view.pressure - view.peep)
        return network.plus(outlet=network.outlet * excess)

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Conductance over pressure."""
        d = np.linspace(0.0, 30.0, 121)
        y = 1e3 / base["R_ex"] * np.asarray(self._excess(values, jnp.asarray(d)))
        return (Curve(d, y, "p - PEEP, cmH2O", "extra conductance, mL/s per cmH2O", (0,)),)

    def _excess(self, values: Values, above: Array) -> Array:
        free = iter(self.coefficients(values))
        return PiecewiseLinear(_OUTLET_KNOTS)(
            above, [0.0 if d == _OUTLET_FIXED else next(free) for d in _OUTLET_KNOTS]
        )


#: Time constants of the opening, s.
_MEMORY_TAUS = (0.015, 0.04, 0.12)


class OutletMemory(FilterBank):
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
            (f"{1e3 * tau:g} ms" for tau in _MEMORY_TAUS),
            unit="1",
            meaning="share of the opening that comes late by",
            low=-1.0,
            high=12.0,
            spread=2.0,
            scan=(0.0, 4.0, 10.0),
        ),
        source="Sum of fixed exponentials.",
        signature="Error at the start of expiration, whatever the inspiration was.",
        confusable=("exhalation_valve_delay", "inertance"),
    )
    taus = _MEMORY_TAUS

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Open."""
        return self.lasting(1.0 + 0.0 * (flow + pressure))

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Opening at the end of the step."""
        states = self.next_state(values, view.state, view.flow, view)
        opened = jnp.maximum(view.opened + self.weighed(values, states - view.opened), 0.0)
        return network.plus(outlet=view.outlet * (opened - view.opened))

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """How far filters of the command are open, 0..1; they close at once."""
        return jnp.minimum(self.step(state, view.opened, view.length), view.opened)

    def curves(self, values: Values, base: Mapping[str, float]) -> tuple[Curve, ...]:
        """Opening over time."""
        t = np.linspace(0.0, 0.5, 251)
        shut = np.minimum(self.decay(values, t), 1.0)
        return (Curve(t, shut, "time after the command to open, s", "share that is still shut"),)


#: Basis terms of this module.
MECHANISMS = (
    OutletShape(),
    OutletMemory(),
)
