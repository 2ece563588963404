"""The inspiratory valve answers late: dead time."""

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Parameter, Values


class ValveDelay(Mechanism):
    """Command of the inspiratory valve, shifted in time."""

    description = Description(
        name="valve_delay", title="dead time of the inspiratory valve", site="inspiratory valve",
        equation="q(t) = q_commanded(t - delay)",
        parameters=(
            Parameter("delay", "s", "dead time",
                      0.0, 0.15, 0.0, 0.04, 0.08, scan=tuple(0.01 * k for k in range(16)),
                      kinked=True),
        ),
        source="Pure transport delay of driver, pilot and tubing; proportional valves of "
        "ventilators answer after 10 to 100 ms, and a delay of one to three samples is what fits "
        "of recorded breaths ask for.",
        signature="Pressure runs ahead of the recording after every edge of the command during "
        "inspiration, by one constant time.",
        confusable=("valve_lag", "sensor_lag", "circuit_compliance"), detectable=0.009, least=0.008,
        least_reason="a quarter of a sample: less is the clock's, not the valve's",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
    )  # fmt: skip

    def dead_time(self, values: Values, time: Array) -> Array:
        """The delay, s."""
        return values["delay"]
