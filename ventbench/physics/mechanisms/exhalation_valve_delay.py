"""The expiratory valve answers late."""

from __future__ import annotations

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class ExhalationValveDelay(Mechanism):
    """Command of the expiratory valve, shifted in time."""

    description = Description(
        name="exhalation_valve_delay",
        title="dead time of the expiratory valve",
        site="expiratory valve",
        equation="open(t) = u_out(t - delay)",
        parameters=(
            Parameter(
                "opening",
                "s",
                "dead time of opening",
                0.0,
                0.15,
                0.0,
                0.05,
                0.1,
                scan=tuple(0.01 * k for k in range(16)),
                kinked=True,
            ),
            Parameter(
                "closing",
                "s",
                "dead time of closing",
                0.0,
                0.15,
                0.0,
                0.0,
                0.0,
                shape=True,
                kinked=True,
            ),
        ),
        source=(
            "Solenoid and diaphragm of the expiratory valve: 0 to 100 ms, of opening and "
            "closing apart."
        ),
        signature=(
            "Pressure stays up after the command to open and then falls as it should; "
            "inspiration is not affected, unless closing is late too."
        ),
        confusable=("inertance", "sensor_lag"),
        detectable=0.003,
        least=0.008,
        least_reason="a quarter of a sample: less is the clock's, not the valve's",
        special_case_of=("outlet_memory",),
    )

    def outlet_dead_time(self, values: Values, u_out: Array) -> Array:
        """Delay of the last command, s."""
        return u_out * values["opening"] + (1.0 - u_out) * values["closing"]


MECHANISM = ExhalationValveDelay()
