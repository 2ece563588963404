"""The sensor's zero changes from a breath on."""

from __future__ import annotations

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter
from ventbench.physics.session import AT, stepped


class ZeroStep(Mechanism):
    """An offset of the reading that is there from a breath on."""

    description = Description(
        name="zero_step",
        title="step of the pressure sensor's zero",
        site="sensor",
        equation="y = p + change after the position `at` of the recording",
        parameters=(
            Parameter(
                "change", "cmH2O", "change of the offset",
                -8.0, 8.0, 0.0, 1.2, 3.0, scan=(1.2, -1.2),
            ),
            AT,
        ),
        source=(
            "A sensor that is zeroed, knocked or plugged in anew between two breaths."
        ),
        signature=(
            "From one breath on, an error that is the same at all samples."
        ),
        confusable=("sensor_drift", "a PEEP that is set anew"),
        detectable=None,
        least=0.15,
        least_reason="two steps of a usual converter",
    )  # fmt: skip

    rank = 1
    uses_position = True

    def sensor_output(self, values: Values, pressure: Array, position: Array) -> Array:
        """Pressure with the offset."""
        return pressure + stepped(values, position)

    def sensor_input(self, values: Values, recorded: Array, position: Array) -> Array:
        """True pressure of a reading."""
        return recorded - stepped(values, position)


MECHANISM = ZeroStep()
