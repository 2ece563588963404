"""The sensor answers slowly."""

from __future__ import annotations

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class SensorLag(Mechanism):
    """The reading follows the airway's pressure through a first-order lag."""

    description = Description(
        name="sensor_lag",
        title="first-order lag of the pressure sensor",
        site="sensor",
        equation="tau dy/dt = p - y",
        parameters=(Parameter("tau", "s", "time constant", 0.0, 0.25, 0.0, 0.05, 0.12),),
        source="Low-pass filter of sensor, sampling line and electronics: 5 to 120 ms.",
        signature=(
            "All edges of pressure are rounded, in inspiration and at the start of "
            "expiration alike, whatever R is."
        ),
        confusable=("valve_lag", "circuit_compliance", "valve_delay"),
        detectable=0.019,
        least=0.012,
        least_reason="a third of a sample: less is an offset between two clocks",
        special_case_of=("sensor_memory",),
    )
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Pressure that the sensor shows, cmH2O."""
        return pressure

    def reading(
        self, values: Values, pressure: Array, state: Array, length: Array
    ) -> tuple[Array, Array]:
        """Implicit step towards the pressure; at ``tau`` = 0 there at once."""
        after = (values["tau"] * state + length * pressure) / (values["tau"] + length)
        return after, after


MECHANISM = SensorLag()
