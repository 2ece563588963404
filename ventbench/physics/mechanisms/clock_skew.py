"""The clocks of commands and pressure run at different rates."""

from __future__ import annotations

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class ClockSkew(Mechanism):
    """A common dead time that grows through each breath."""

    description = Description(
        name="clock_skew",
        title="clocks of commands and pressure that run apart",
        site="sensor",
        equation="y(t) = p(t - skew t), t = time since the start of the breath",
        parameters=(
            Parameter(
                "skew", "1", "share of the time by which pressure falls behind",
                0.0, 0.04, 0.0, 0.01, 0.025, scan=(0.0, 0.003, 0.006, 0.012, 0.02, 0.03),
                kinked=True, share=True,
            ),
        ),
        source=(
            "Quartz clocks agree to 0.01 %; those of operating systems, and rates that are given "
            "as rounded numbers, to 0.1 to 4 %."
        ),
        signature=(
            "Early edges are on time; others come late in proportion to the time in the breath."
        ),
        confusable=("clock_offset", "exhalation_valve_delay", "valve_delay"),
        detectable=None,
        least=0.002,
        least_reason="4 ms at the end of a breath of 2 s",
    )  # fmt: skip

    def dead_time(self, values: Values, time: Array) -> Array:
        """The delay of a command at a time in the breath, s."""
        return values["skew"] * time

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """The delay of a command at a time in the breath, s."""
        return values["skew"] * time


MECHANISM = ClockSkew()
