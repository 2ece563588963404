"""The inspiratory valve passes nothing at small commands."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Parameter, Values

#: Travel in which a stuck seat lets go, as a share of the band: short, but with a slope by which a
#: fit finds the width.
_LETS_GO = 0.2

#: Width, %, so that none is no division by zero.
_THIN = 1e-6


class ValveDeadBand(Mechanism):
    """The first part of the stroke gives no flow."""

    description = Description(
        name="valve_dead_band", title="dead band of the inspiratory valve",
        site="inspiratory valve",
        equation="u_effective = 0 below width, u - (1 - crack) width above",
        parameters=(
            Parameter("width", "%", "command at which flow begins", 0.0, 10.0, 0.0, 1.5, 3.5),
            Parameter("crack", "1",
                      "0 for overlap, which every command loses; 1 for a stuck seat that cracks "
                      "open",
                      0.0, 1.0, 0.0, 0.0, 0.0, shape=True, grid=(0.0, 1.0)),
            Parameter("driver", "1",
                      "share of the width that is lost before the valve's play, not behind it: 0 "
                      "for overlap of the seat, 1 for a driver with a least command",
                      0.0, 1.0, 0.0, 0.0, 0.0, shape=True, grid=(0.0, 1.0)),
        ),
        source="Overlap of the spool or friction of the seat; 0 to 5 % of the stroke is usual "
        "without linearisation (ISA-75.25: dead band and resolution of control valves).",
        signature="Too little flow at every small command, none at the smallest: late in "
        "inspiration, and in lungs with high R and low C, which are ventilated with small "
        "commands.",
        confusable=("leak", "command_rounding", "valve_hysteresis"), detectable=0.1, least=0.25,
        least_reason="a quarter of a percent of stroke, the resolution of drivers",
        special_case_of=("valve_shape",),
    )  # fmt: skip

    rank = 2

    def driven(self, values: Values, u_in: Array) -> Array:
        """Remainder of the command behind the driver."""
        return _remainder(values, u_in, values["driver"] * values["width"])

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Remainder of the command; a negative one is not a valve's and passes."""
        return _remainder(values, u_in, (1.0 - values["driver"]) * values["width"]), memory


def _remainder(values: Values, u_in: Array, width: Array) -> Array:
    """What a dead band of some width, %, leaves of a command, %."""
    positive = jnp.maximum(u_in, 0.0)
    lost = jnp.minimum(positive, width)
    free = jnp.clip(0.5 + (positive - width) / (_LETS_GO * width + _THIN), 0.0, 1.0)
    stuck = positive * (1.0 - free)
    return u_in - lost - values["crack"] * (stuck - lost)
