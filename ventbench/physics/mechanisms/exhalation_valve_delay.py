"""The expiratory valve answers late."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View


class ExhalationValveDelay(Mechanism):
    """Command of the expiratory valve, shifted in time, and an opening that takes its time.

    The strength is the mean delay of the opening, of which a share is a first-order lag. The valve
    closes promptly, but for a dead time of its own.
    """

    description = Description(
        name="exhalation_valve_delay", title="delay of the expiratory valve",
        site="expiratory valve",
        equation="opening slow do/dt = u_out(t - opening (1 - slow)) - o",
        parameters=(
            Parameter("opening", "s", "mean delay of opening",
                      0.0, 0.15, 0.0, 0.05, 0.1, scan=tuple(0.01 * k for k in range(16)),
                      kinked=True),
            Parameter("closing", "s", "dead time of closing",
                      0.0, 0.15, 0.0, 0.0, 0.0, shape=True, kinked=True),
            Parameter("slow", "1",
                      "share of the opening's delay that is a lag: 0 for a dead time, 1 for a "
                      "valve that opens slowly",
                      0.0, 1.0, 0.0, 0.0, 0.0, shape=True, grid=(0.0, 1.0), share=True),
        ),
        source="Solenoid and diaphragm of the expiratory valve: 0 to 100 ms, of opening and "
        "closing apart. A diaphragm on a vented pilot opens as its pilot empties.",
        signature="Pressure stays up after the command to open, or falls slowly at first, whatever "
        "the lung; inspiration is not affected, unless closing is late too.",
        confusable=("inertance", "sensor_lag"), detectable=0.003, least=0.008,
        least_reason="a quarter of a sample: less is the clock's, not the valve's",
        special_case_of=("outlet_memory",),
    )  # fmt: skip
    stateful = True

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """Delay of the last command, s."""
        opening = values["opening"] * (1.0 - values["slow"])
        return u_out * opening + (1.0 - u_out) * values["closing"]

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Open."""
        return 1.0 + 0.0 * (flow + pressure)

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Opening at the end of the step."""
        opened = self.next_state(values, view.state, view.flow, view)
        return network.plus(outlet=view.outlet * (opened - view.opened))

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """How far the valve is open, 0..1; it closes at once."""
        tau = values["opening"] * values["slow"]
        before = jnp.clip(state, 0.0, 1.0)  # where it closes, a stage starts beyond
        after = (tau * before + view.length * view.opened) / (tau + view.length)
        return jnp.minimum(after, view.opened)
