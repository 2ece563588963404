"""The supply's pressure falls with the flow of the last second."""

from __future__ import annotations

from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class SupplyDroop(Mechanism):
    """Flow is divided by what recent flow has cost the supply."""

    description = Description(
        name="supply_droop",
        title="supply that sags with recent flow",
        site="supply",
        equation="q = q_valve / (1 + k s), recovery ds/dt = q - s, k = drop / (1 - drop) / 0.5",
        parameters=(
            Parameter(
                "drop",
                "1",
                "share of the flow that is lost at a lasting 0.5 L/s",
                0.0,
                0.7,
                0.0,
                0.1,
                0.3,
                share=True,
            ),
            Parameter(
                "recovery",
                "s",
                "time constant",
                0.1,
                5.0,
                1.0,
                1.0,
                1.0,
                "log",
                shape=True,
                uncertain=True,
            ),
        ),
        source=(
            "Reservoir behind a regulator or blower: its pressure falls with the flow drawn "
            "from it and recovers in about a second."
        ),
        signature="Flow is lost late in inspiration and in big breaths; after a pause it is back.",
        confusable=("valve_curve", "leak", "viscoelasticity"),
        detectable=0.02,
        least=0.03,
        least_reason="regulators hold their pressure to a few percent",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
    )

    rank = 1
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Recent flow, L/s."""
        return flow

    def inflow(
        self, values: Values, flow: Array, state: Array, length: Array
    ) -> tuple[Array, Array]:
        """Flow that the supply can give; recent flow is predicted, then corrected."""
        sag = values["drop"] / (1.0 - values["drop"]) / 0.5
        time = values["recovery"]
        ahead = (time * state + length * flow / (1.0 + sag * state)) / (time + length)
        given = flow / (1.0 + sag * ahead)
        return given, (time * state + length * given) / (time + length)


MECHANISM = SupplyDroop()
