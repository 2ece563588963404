"""The supply's pressure falls with the flow of the last second."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Pair, Parameter, Values

#: Flow for which the lost share is given, L/s.
REFERENCE = 0.5

#: Least share of the flow that a supply gives.
_LEAST = 0.02


class SupplyDroop(Mechanism):
    """Flow is reduced by what recent flow has cost the supply."""

    description = Description(
        name="supply_droop", title="supply that sags with recent flow", site="supply",
        equation="q = q_valve ((1 - linear) / (1 + k s) + linear (1 - drop s / 0.5)), recovery "
        "ds/dt = q - s, k = drop / (1 - drop) / 0.5",
        parameters=(
            Parameter("drop", "1", "share of the flow that is lost at a lasting 0.5 L/s",
                      0.0, 0.7, 0.0, 0.1, 0.3, share=True),
            Parameter("recovery", "s", "time constant",
                      0.1, 5.0, 1.0, 1.0, 1.0, "log", shape=True, uncertain=True),
            Parameter("linear", "1",
                      "1 where the loss grows with recent flow as a regulator's does, 0 where it "
                      "levels off",
                      0.0, 1.0, 0.0, 0.0, 0.0, shape=True, grid=(0.0, 1.0)),
        ),
        source="Reservoir behind a regulator or blower: its pressure falls with the flow drawn "
        "from it and recovers in about a second. A regulator's pressure falls in proportion to the "
        "flow (ISO 6953), and the flow of a sonic valve in proportion to that pressure (ISO 6358).",
        signature="Flow is lost late in inspiration and in big breaths; after a pause it is back.",
        confusable=("valve_curve", "leak", "viscoelasticity"), detectable=0.02, least=0.03,
        least_reason="regulators hold their pressure to a few percent",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
    )  # fmt: skip

    rank = 1
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Recent flow, L/s."""
        return flow

    def inflow(self, values: Values, flow: Array, state: Array, length: Array) -> Pair:
        """Flow that the supply can give; recent flow is predicted, then corrected."""
        time = values["recovery"]
        ahead = (time * state + _given(values, length * flow, state)) / (time + length)
        given = _given(values, flow, ahead)
        return given, (time * state + length * given) / (time + length)


def _given(values: Values, flow: Array, recent: Array) -> Array:
    """What a supply gives of a flow, L/s, after a recent flow, L/s."""
    drop, linear = values["drop"], values["linear"]
    levelling = flow / (1.0 + drop / (1.0 - drop) / REFERENCE * recent)
    proportional = flow * jnp.maximum(1.0 - drop / REFERENCE * recent, _LEAST)
    return (1.0 - linear) * levelling + linear * proportional
