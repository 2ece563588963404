"""The sensor's zero moves in the course of a recording."""

from __future__ import annotations

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter
from ventbench.physics.session import WARMING, grown


class SensorDrift(Mechanism):
    """Offset that grows with the breath's place in the recording."""

    description = Description(
        name="sensor_drift",
        title="drift of the pressure sensor",
        site="sensor",
        equation=(
            "y = p (1 + gain g) + drift g, g = (1 - exp(-warming x)) / (1 - exp(-warming)), "
            "x = position of the breath in the recording, 0..1"
        ),
        parameters=(
            Parameter(
                "drift", "cmH2O", "change of the offset from the first breath to the last",
                -8.0, 8.0, 0.0, 1.2, 3.0,
            ),
            Parameter(
                "gain", "1", "change of the gain over the recording",
                -0.3, 0.3, 0.0, 0.0, 0.0, shape=True, share=True,
            ),
            WARMING,
        ),
        source=(
            "Temperature and ageing of piezoresistive sensors between two zeroings: up to 3 "
            "cmH2O a recording."
        ),
        signature=(
            "An error that grows with the number of the breath and is the same at all its samples."
        ),
        confusable=("zero_step", "a PEEP that changes during the recording"),
        detectable=0.05,
        least=0.15,
        least_reason="two steps of a usual converter",
        special_case_of=("drift_shape",),
    )  # fmt: skip

    rank = 1
    uses_position = True

    def sensor_output(self, values: Values, pressure: Array, position: Array) -> Array:
        """Drifted pressure."""
        share = grown(values, position)
        return pressure * (1.0 + values["gain"] * share) + values["drift"] * share

    def sensor_input(self, values: Values, shown: Array, position: Array) -> Array:
        """True pressure of a reading."""
        share = grown(values, position)
        return (shown - values["drift"] * share) / (1.0 + values["gain"] * share)


MECHANISM = SensorDrift()
