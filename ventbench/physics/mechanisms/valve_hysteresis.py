"""The inspiratory valve stands higher when closing than when opening."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter

#: Width, %, so that none is no division by zero.
_THIN = 1e-6


class ValveHysteresis(Mechanism):
    """Rate-independent memory of the command."""

    description = Description(
        name="valve_hysteresis",
        title="play of the inspiratory valve",
        site="inspiratory valve",
        equation=(
            "u_effective = u - h ((1 - give) clip(x, -1, 1) + give tanh x), h = width / 2, "
            "x = (u - u_effective before) / h"
        ),
        parameters=(
            Parameter("width", "%", "command lost at every reversal", 0.0, 15.0, 0.0, 2.0, 5.0),
            Parameter(
                "give",
                "1",
                "0 for slack, 1 for a drive that gives before it moves the seat",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
            ),
        ),
        source=(
            "Play (backlash) operator: friction and slack between driver and seat, or "
            "opening and closing tables that differ. 3.8 % of full scale was measured on "
            "the PVP's valve."
        ),
        signature=(
            "After each reversal of the command flow stays where it was; error of one sign "
            "while the command rises and of the other while it falls."
        ),
        confusable=("valve_dead_band", "valve_delay"),
        detectable=0.1,
        least=0.3,
        least_reason="a little more than the resolution of drivers",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
    )

    rank = 1
    has_memory = True

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Position of the valve, %, which is also its memory."""
        half = 0.5 * values["width"]
        hard = jnp.minimum(jnp.maximum(memory, u_in - half), u_in + half)
        soft = u_in - half * jnp.tanh((u_in - memory) / (half + _THIN))
        position = hard + values["give"] * (soft - hard)
        return position, position


MECHANISM = ValveHysteresis()
