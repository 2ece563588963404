"""Pressure is recorded late against the commands."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class ClockOffset(Mechanism):
    """One dead time of all commands: that of a path or clock that all readings share."""

    description = Description(
        name="clock_offset",
        title="delay between commands and pressure",
        site="sensor",
        equation="y(t) = p(t - offset): both commands act late by one time",
        parameters=(
            Parameter(
                "offset", "s", "common dead time",
                0.0, 0.15, 0.0, 0.03, 0.06, scan=tuple(0.01 * k for k in range(16)), kinked=True,
            ),
        ),
        source=(
            "Clocks that are not aligned, a buffer of one to three samples before the log, or a "
            "sensor with a dead time."
        ),
        signature=(
            "All that happens in pressure comes late by one time, at edges of both valves alike."
        ),
        confusable=("valve_delay", "exhalation_valve_delay", "sensor_lag"),
        detectable=None,
        least=0.008,
        least_reason="a quarter of a sample: less is within the time stamps of a log",
    )  # fmt: skip

    def dead_time(self, values: Values, time: Array) -> Array:
        """The delay, s."""
        return values["offset"]

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """The delay, s; before the breath, nothing leaves, as the lung is at rest."""
        return jnp.where((time < values["offset"]) & (u_out < 0.5), 0.0, values["offset"])


MECHANISM = ClockOffset()
