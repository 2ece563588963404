"""The inspiratory valve passes nothing at small commands."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class ValveDeadBand(Mechanism):
    """The first part of the stroke gives no flow."""

    description = Description(
        name="valve_dead_band",
        title="dead band of the inspiratory valve",
        site="inspiratory valve",
        equation="u_effective = 0 below width, u - width above",
        parameters=(
            Parameter("width", "%", "command at which flow begins", 0.0, 10.0, 0.0, 1.5, 3.5),
        ),
        source=(
            "Overlap of the spool and friction of the seat; 0 to 5 % of the stroke is usual "
            "without linearisation."
        ),
        signature=(
            "Too little flow at every small command, none at the smallest: late in "
            "inspiration, and in lungs with high R and low C, which are ventilated with "
            "small commands."
        ),
        confusable=("leak", "command_rounding", "valve_hysteresis"),
        detectable=0.1,
        least=0.25,
        least_reason="a quarter of a percent of stroke, the resolution of drivers",
        special_case_of=("valve_shape",),
    )

    rank = 2

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Remainder of the command; a negative one is not a valve's and passes."""
        return u_in - jnp.minimum(jnp.maximum(u_in, 0.0), values["width"]), memory


MECHANISM = ValveDeadBand()
