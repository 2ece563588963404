"""The sensor answers slowly."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Pair, Parameter, Values


class SensorLag(Mechanism):
    """The reading follows the airway's pressure through one lag or two."""

    description = Description(
        name="sensor_lag", title="lag of the pressure sensor", site="sensor",
        equation="tau dx/dt = p - x, second dy/dt = x - y",
        parameters=(
            Parameter("tau", "s", "time constant", 0.0, 0.25, 0.0, 0.05, 0.12),
            Parameter("second", "s",
                      "time constant of a lag behind the first, as of a filter behind a sampling "
                      "line",
                      0.0, 0.25, 0.0, 0.0, 0.0, shape=True),
        ),
        source="Low-pass filter of sensor, sampling line and electronics: 5 to 120 ms.",
        signature="All edges of pressure are rounded, in inspiration and at the start of "
        "expiration alike, whatever R is.",
        confusable=("valve_lag", "circuit_compliance", "valve_delay"), detectable=0.019,
        least=0.012, least_reason="a third of a sample: less is an offset between two clocks",
        special_case_of=("sensor_memory",),
        interchangeable=(("tau", "second"),),
    )  # fmt: skip
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Pressure behind each lag, cmH2O."""
        return jnp.stack([pressure + 0.0 * flow] * 2)

    def reading(self, values: Values, pressure: Array, state: Array, length: Array) -> Pair:
        """Implicit step towards the pressure; a lag of 0 s is there at once."""
        first = (values["tau"] * state[0] + length * pressure) / (values["tau"] + length)
        # So written, a second lag of 0 s changes no bit.
        after = first + values["second"] / (values["second"] + length) * (state[1] - first)
        return after, jnp.stack([first, after])
