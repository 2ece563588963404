"""The lung's compliance changes from a breath on."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter
from ventbench.physics.session import AT, stepped


class ComplianceStep(Mechanism):
    """A compliance that changes between two breaths."""

    description = Description(
        name="compliance_step",
        title="step of the compliance",
        site="alveolus",
        equation="C = C (1 + change) after the position `at` of the recording",
        parameters=(
            Parameter(
                "change", "1", "change, as a share of C before",
                -0.7, 2.0, 0.0, 0.2, 0.4, scan=(0.2, -0.2), share=True,
            ),
            AT,
        ),
        source=(
            "Turning, a lobe that opens or collapses, or a spring that is exchanged changes 20 to "
            "50 % of the compliance between two breaths."
        ),
        signature=(
            "From one breath on, an error that grows with volume."
        ),
        confusable=("compliance_drift", "gain_step", "resistance_step"),
        detectable=None,
        least=0.03,
        least_reason="test lungs repeat their compliance to a few percent",
    )  # fmt: skip

    uses_position = True

    def of_breath(self, values: Values, base: Values) -> Values:
        """C at the breath."""
        changed = 1.0 + stepped(values, base["position"])
        return {**base, "C": base["C"] * changed}


MECHANISM = ComplianceStep()
