"""exhalation path: any conductance of the expiratory valve, which may open slowly."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.network import Network, View
from ventbench.physics.slots._curves import Hats, beside
from ventbench.physics.slots._element import Element, Shape, coefficients

#: p - PEEP where the factor bends, cmH2O; where it is 1, the conductance is 1 / R_ex.
_KNOTS = (0.0, 2.0, 5.0, 10.0, 20.0)
_FIXED = 5.0
_FREE = tuple(d for d in _KNOTS if d != _FIXED)

#: Time constants of the opening, s.
_TAUS = (0.015, 0.04, 0.12)


class OutletShape(Element):
    """A factor of the open valve's conductance, and a memory of its opening.

    The factor is 1 at 5 cmH2O above PEEP: there R_ex is R_ex. Closing is prompt. A conductance
    below zero is zero, so that an answer that overshoots downwards is a dead time.
    """

    description = Description(
        name="outlet_shape",
        title="exhalation path: any conductance of the expiratory valve",
        site="expiratory valve",
        equation=(
            "q_out = o (1 + f(p - PEEP)) (p - PEEP) / R_ex, f straight between knots, f(5 cmH2O) = "
            "0, o = max(0, u_out + sum_k c_k (s_k - u_out)), tau_k ds_k/dt = u_out - s_k"
        ),
        parameters=(
            *coefficients(
                (f"p - PEEP = {d:g} cmH2O" for d in _FREE), "1",
                "conductance above 1 / R_ex, times R_ex, at", -0.9, 6.0, 1.0,
            ),
            *coefficients(
                (f"{1e3 * tau:g} ms" for tau in _TAUS), "1",
                "share of the opening that comes late by", -1.0, 12.0, 2.0, prefix="late",
                scan=(0.0, 4.0, 10.0),
            ),
        ),
        source="Straight lines between fixed knots, as of a diaphragm on a spring; exponentials.",
        signature="Error during expiration only, whatever the inspiration was.",
        confusable=("exhalation_valve_delay", "inertance"),
    )  # fmt: skip
    stateful = True

    def rest(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Open."""
        return jnp.stack([1.0 + 0.0 * (flow + pressure)] * len(_TAUS))

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Conductance at the last pressure."""
        factor = 1.0 + self._excess(values, view.pressure - view.peep)
        states = self.settle(values, view.state, view.flow, view)
        late = jnp.stack([values[f"late{k}"] + 0.0 * view.opened for k in (1, 2, 3)])
        opened = view.opened + jnp.sum(late * (states - view.opened), axis=0)
        return network.plus(outlet=view.outlet * (factor * jnp.maximum(opened, 0.0) - view.opened))

    def settle(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """How far filters of the command are open, 0..1; they close at once."""
        taus = beside(_TAUS, state)
        after = (taus * state + view.length * view.opened) / (taus + view.length)
        return jnp.minimum(after, view.opened)

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Conductance over pressure, and opening over time."""
        d = np.linspace(0.0, 30.0, 121)
        y = 1e3 / base["R_ex"] * np.asarray(self._excess(values, jnp.asarray(d)))
        t = np.linspace(0.0, 0.5, 251)
        late = np.array([float(values[f"late{k}"]) for k in (1, 2, 3)])
        shut = np.minimum(np.exp(-t[:, None] / np.array(_TAUS)) @ late, 1.0)
        curve = Shape(d, y, "p - PEEP, cmH2O", "extra conductance, mL/s per cmH2O", (0,))
        opening = Shape(t, shut, "time after the command to open, s", "share that is still shut")
        slow = np.abs(late).max() / 2.0 >= max(abs(float(values[f"c{k}"])) for k in range(1, 5))
        return (opening, curve) if slow else (curve, opening)

    def _excess(self, values: Values, above: Array) -> Array:
        free = iter([values[f"c{k}"] for k in range(1, 5)])
        return Hats(_KNOTS)(above, [0.0 if d == _FIXED else next(free) for d in _KNOTS])


MECHANISM = OutletShape()
