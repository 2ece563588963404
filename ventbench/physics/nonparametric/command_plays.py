"""memory of u: any memory of the command that does not depend on time, only on its reversals."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import Description, Values
from ventbench.physics.nonparametric._curves import beside
from ventbench.physics.nonparametric._element import Element, Shape, coefficients

#: Widths of the plays, %.
_WIDTHS = (1.0, 2.5, 5.0, 10.0)


class CommandPlays(Element):
    """A sum of play operators (Prandtl and Ishlinskii) on the command.

    While the command rises they take a constant away, which a dead band would too.
    """

    description = Description(
        name="command_plays",
        title="memory of u: any hysteresis of the valve",
        site="inspiratory valve",
        equation="u_effective = u + sum_k c_k (s_k - u), s_k = clip(s_k before, u -+ width_k / 2)",
        parameters=coefficients(
            (f"{width:g} %" for width in _WIDTHS), "1", "share of the valve with a play of", -2.0,
            2.0, 0.7,
        ),
        source="Sum of plays of fixed widths; holds any hysteresis that knows no time.",
        signature="Error of one sign while the command rises and of the other while it falls.",
        confusable=("valve_hysteresis", "valve_dead_band"),
    )  # fmt: skip
    rank = 4
    remembers = True

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Where the plays stand, %, ``(K, ...)``, and what they make of the command."""
        half = 0.5 * beside(_WIDTHS, jnp.broadcast_to(u_in, (len(_WIDTHS), *u_in.shape)))
        stands = jnp.minimum(jnp.maximum(memory, u_in - half), u_in + half)
        late = jnp.sum(self.stacked(values, stands) * (stands - u_in), axis=0)
        return u_in + late, stands

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Change of the flow while the command rises to 30 % and falls again."""
        u = np.concatenate([np.linspace(0.0, 30.0, 121), np.linspace(30.0, 0.0, 121)[1:]])
        stands, change = np.zeros(len(_WIDTHS)), []
        half = 0.5 * np.array(_WIDTHS)
        for command in u:
            stands = np.clip(stands, command - half, command + half)
            late = np.array([float(c) for c in self.coefficients(values)]) @ (stands - command)
            change.append(base["gain"] * late)
        return (Shape(u, np.array(change), "command up and down, %", "extra flow, mL/s"),)


MECHANISM = CommandPlays()
