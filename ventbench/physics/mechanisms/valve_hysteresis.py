"""The inspiratory valve stands higher when closing than when opening."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Parameter, Values

#: Width, %, so that none is no division by zero.
_THIN = 1e-6


class ValveHysteresis(Mechanism):
    """Rate-independent memory of the command."""

    description = Description(
        name="valve_hysteresis", title="play of the inspiratory valve", site="inspiratory valve",
        equation="u_effective = u - h z, h = width / 2, z = (1 - smooth) ((1 - give) clip(x, -1, "
        "1) + give tanh x) + smooth (s + (z before - s) exp(-|d| / h)), x = z before + d / h, d = "
        "u - u before, s = sign d",
        parameters=(
            Parameter("width", "%", "command lost at every reversal", 0.0, 15.0, 0.0, 2.0, 5.0),
            Parameter("give", "1", "0 for slack, 1 for a drive that gives before it moves the seat",
                      0.0, 1.0, 0.0, 0.0, 0.0, shape=True),
            Parameter("smooth", "1",
                      "1 for a lag that nears its width exponentially with the travel",
                      0.0, 1.0, 0.0, 0.0, 0.0, shape=True, grid=(0.0, 1.0)),
        ),
        source="Play (backlash) operator: friction and slack between driver and seat, or opening "
        "and closing tables that differ. 3.8 % of full scale was measured on the PVP's valve. With "
        "smooth 1 the hysteresis of Bouc (1967) and Wen (J. Eng. Mech. 102, 1976, 249), whose "
        "memory is that of the travel, not of time.",
        signature="After each reversal of the command flow stays where it was; error of one sign "
        "while the command rises and of the other while it falls.",
        confusable=("valve_dead_band", "valve_delay"), detectable=0.1, least=0.3,
        least_reason="a little more than the resolution of drivers",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
    )  # fmt: skip

    rank = 1
    has_memory = True

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Position of the valve, %; the memory is that and the command, ``(2, ...)``."""
        half = 0.5 * values["width"]
        position, before = jnp.broadcast_to(memory, (2, *u_in.shape))
        hard = jnp.minimum(jnp.maximum(position, u_in - half), u_in + half)
        soft = u_in - half * jnp.tanh((u_in - position) / (half + _THIN))
        yielding = hard + values["give"] * (soft - hard)
        travel = u_in - before
        full = half * jnp.sign(travel)
        left = jnp.exp(-jnp.abs(travel) / (half + _THIN))
        gradual = u_in - full - (before - position - full) * left
        position = yielding + values["smooth"] * (gradual - yielding)
        return position, jnp.stack([position, u_in])
