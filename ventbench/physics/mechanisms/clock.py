"""Clocks of commands and pressure that are not one: an offset, and different rates."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Parameter, Values


class ClockOffset(Mechanism):
    """One dead time of all commands: that of a path or clock that all readings share."""

    description = Description(
        name="clock_offset", title="delay between commands and pressure", site="sensor",
        equation="y(t) = p(t - offset): both commands act late by one time",
        parameters=(
            Parameter("offset", "s", "common dead time",
                      0.0, 0.15, 0.0, 0.03, 0.06, scan=tuple(0.01 * k for k in range(16)),
                      kinked=True),
        ),
        source="Clocks that are not aligned, a buffer of one to three samples before the log, or a "
        "sensor with a dead time.",
        signature="All that happens in pressure comes late by one time, at edges of both valves "
        "alike.",
        confusable=("valve_delay", "exhalation_valve_delay", "sensor_lag"), least=0.008,
        least_reason="a quarter of a sample: less is within the time stamps of a log",
    )  # fmt: skip

    def dead_time(self, values: Values, time: Array) -> Array:
        """The delay, s."""
        return values["offset"]

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """The delay, s; before the breath, nothing leaves, as the lung is at rest."""
        return jnp.where((time < values["offset"]) & (u_out < 0.5), 0.0, values["offset"])


class ClockSkew(Mechanism):
    """A common dead time that grows through each breath."""

    description = Description(
        name="clock_skew", title="clocks of commands and pressure that run apart", site="sensor",
        equation="y(t) = p(t - skew t), t = time since the start of the breath",
        parameters=(
            Parameter("skew", "1", "share of the time by which pressure falls behind",
                      0.0, 0.04, 0.0, 0.01, 0.025, scan=(0.0, 0.003, 0.006, 0.012, 0.02, 0.03),
                      kinked=True, share=True),
        ),
        source="Quartz clocks agree to 0.01 %; those of operating systems, and rates that are "
        "given as rounded numbers, to 0.1 to 4 %.",
        signature="Early edges are on time; others come late in proportion to the time in the "
        "breath.",
        confusable=("clock_offset", "exhalation_valve_delay", "valve_delay"), least=0.002,
        least_reason="4 ms at the end of a breath of 2 s",
    )  # fmt: skip

    def dead_time(self, values: Values, time: Array) -> Array:
        """The delay of a command at a time in the breath, s."""
        return values["skew"] * time

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """The delay of a command at a time in the breath, s."""
        return values["skew"] * time
