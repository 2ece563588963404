"""The driver passes whole percents only."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Parameter, Values


class CommandRounding(Mechanism):
    """Integer positions of the valve behind a logged fractional command."""

    description = Description(
        name="command_rounding", title="command rounded to whole percents", site="command",
        equation="u_effective = u + amount (floor(u + bias) - u)",
        parameters=(
            Parameter("amount", "1",
                      "share of the rounding that is seen: 1 if the valve gets whole percents",
                      0.0, 1.0, 0.0, 1.0, 1.0),
            Parameter("bias", "%", "0 cuts off, 0.5 rounds to the nearest; no derivative: try both",
                      0.0, 0.5, 0.0, 0.0, 0.0, shape=True, grid=(0.0, 0.5), discrete=True),
        ),
        source=(
            "Valve drivers that take integers while the controller logs its fractional request."
        ),
        signature="Cut off, half a percent of the command is missing on average, which looks like "
        "a dead band of 0.5 %; what remains follows the fraction of each command.",
        confusable=("valve_dead_band",), least=0.5,
        least_reason="a driver rounds or does not; half a rounding is another effect",
        special_case_of=("valve_shape",),
    )  # fmt: skip

    def driven(self, values: Values, u_in: Array) -> Array:
        """The command, moved towards a whole number."""
        whole = jnp.floor(u_in + values["bias"])
        return u_in + values["amount"] * (whole - u_in)
