"""A relief valve opens at a high pressure."""

from __future__ import annotations

from ventbench.physics.mechanism import Description
from ventbench.physics.mechanisms.relief_leak import ReliefLeak
from ventbench.physics.parameters import Parameter


class ReliefValve(ReliefLeak):
    """A flow out of the circuit above a set pressure."""

    description = Description(
        name="relief_valve",
        title="relief valve of the circuit",
        site="circuit",
        equation="q_out = conductance max(p - opening, 0)",
        parameters=(
            Parameter(
                "conductance", "mL/s per cmH2O", "of the open valve", 0.0, 2000.0, 0.0, 200.0, 400.0
            ),
            Parameter("opening", "cmH2O", "where it opens", 20.0, 120.0, 60.0, 60.0, 60.0),
        ),
        source=(
            "Ventilators limit the pressure of the circuit by a spring-loaded valve, at 60 to "
            "80 cmH2O; no recording of the PVP goes above 61.4."
        ),
        signature="Pressure does not rise above the opening pressure, whatever the command.",
        confusable=("leak",),
    )


MECHANISM = ReliefValve()
