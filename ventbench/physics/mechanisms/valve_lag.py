"""The inspiratory valve answers slowly."""

from __future__ import annotations

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class ValveLag(Mechanism):
    """Flow of the valve follows what is asked for, through a first-order lag."""

    description = Description(
        name="valve_lag",
        title="first-order lag of the inspiratory valve",
        site="inspiratory valve",
        equation="tau dq/dt = q_commanded - q",
        parameters=(Parameter("tau", "s", "time constant", 0.0, 0.2, 0.0, 0.04, 0.1),),
        source=(
            "First-order actuator; time constants of 5 to 100 ms are usual for proportional "
            "solenoid valves."
        ),
        signature=(
            "Edges of the command arrive rounded during inspiration; the start of "
            "expiration is not affected."
        ),
        confusable=("sensor_lag", "circuit_compliance", "valve_delay"),
        detectable=0.009,
    )
    stateful = True

    def rest(self, values: Values, flow: Array, pressure: Array) -> Array:
        """The resting flow, L/s."""
        return flow

    def inflow(
        self, values: Values, flow: Array, state: Array, length: Array
    ) -> tuple[Array, Array]:
        """Implicit step towards the commanded flow; at ``tau`` = 0 there at once."""
        after = (values["tau"] * state + length * flow) / (values["tau"] + length)
        return after, after


MECHANISM = ValveLag()
