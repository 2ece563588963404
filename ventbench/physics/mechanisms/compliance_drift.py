"""The lung's compliance changes in the course of a recording."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class ComplianceDrift(Mechanism):
    """A compliance that grows or falls with the number of the breath."""

    description = Description(
        name="compliance_drift",
        title="compliance that changes over the recording",
        site="alveolus",
        equation="C(x) = C (1 + change x), x = position of the breath in the recording, 0..1",
        parameters=(
            Parameter(
                "change", "1", "change from the first breath to the last, as a share of C",
                -0.7, 2.0, 0.0, 0.2, 0.4, share=True,
            ),
        ),
        source=(
            "Recruitment and derecruitment move compliance by tens of percent within minutes "
            "(Hickling, Am. J. Respir. Crit. Care Med. 158, 1998, 194); springs and bellows of "
            "test lungs settle as they warm up."
        ),
        signature="An error that grows with volume and with the number of the breath.",
        confusable=("compliance_step", "sensor_drift", "resistance_drift"),
        detectable=None,
        least=0.03,
        least_reason="test lungs repeat their compliance to a few percent",
    )  # fmt: skip

    uses_position = True

    def of_breath(self, values: Values, base: Values) -> Values:
        """C at the breath."""
        grown = 1.0 + values["change"] * base["position"]
        return {**base, "C": base["C"] * grown}


MECHANISM = ComplianceDrift()
