"""The inspiratory valve answers slowly."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Pair, Parameter, Values


class ValveLag(Mechanism):
    """Flow of the valve follows the commanded flow through one lag or two."""

    description = Description(
        name="valve_lag", title="lag of the inspiratory valve", site="inspiratory valve",
        equation="tau dx/dt = q_commanded - x, second dq/dt = x - q",
        parameters=(
            Parameter("tau", "s", "time constant", 0.0, 0.2, 0.0, 0.04, 0.1),
            Parameter("second", "s", "time constant of a lag behind the first, as of a pilot stage",
                      0.0, 0.2, 0.0, 0.0, 0.0, shape=True),
        ),
        source="First-order actuator; time constants of 5 to 100 ms are usual for proportional "
        "solenoid valves.",
        signature="Edges of the command arrive rounded during inspiration; the start of expiration "
        "is not affected.",
        confusable=("sensor_lag", "circuit_compliance", "valve_delay"), detectable=0.009,
        least=0.008,
        least_reason="a quarter of a sample: less rounds no edge that a recording shows",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
        interchangeable=(("tau", "second"),),
    )  # fmt: skip
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """The resting flow behind both lags, L/s."""
        return jnp.stack([flow + 0.0 * pressure] * 2)

    def inflow(self, values: Values, flow: Array, state: Array, length: Array) -> Pair:
        """Implicit step towards the commanded flow; a lag of 0 s is there at once."""
        first = (values["tau"] * state[0] + length * flow) / (values["tau"] + length)
        after = (values["second"] * state[1] + length * first) / (values["second"] + length)
        return after, jnp.stack([first, after])
