"""The airway's resistance changes from a breath on."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter
from ventbench.physics.session import AT, stepped


class ResistanceStep(Mechanism):
    """A resistance that changes between two breaths."""

    description = Description(
        name="resistance_step",
        title="step of the resistance",
        site="airway",
        equation="R = R (1 + change) after the position `at` of the recording",
        parameters=(
            Parameter(
                "change", "1", "change, as a share of R before",
                -0.8, 3.0, 0.0, 0.3, 0.6, scan=(0.3, -0.3), share=True,
            ),
            AT,
        ),
        source=(
            "A hose that kinks, a plug of secretions or its suction, or a resistor that is "
            "exchanged between two breaths."
        ),
        signature=(
            "From one breath on, an error that grows with flow."
        ),
        confusable=("resistance_drift", "gain_step", "compliance_step"),
        detectable=None,
        least=0.05,
        least_reason="resistors repeat to a few percent",
    )  # fmt: skip

    uses_position = True

    def of_breath(self, values: Values, base: Values) -> Values:
        """R at the breath."""
        changed = 1.0 + stepped(values, base["position"])
        return {**base, "R": base["R"] * changed}


MECHANISM = ResistanceStep()
