"""The airway's resistance changes in the course of a recording."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class ResistanceDrift(Mechanism):
    """A resistance that grows or falls with the number of the breath."""

    description = Description(
        name="resistance_drift",
        title="resistance that changes over the recording",
        site="airway",
        equation="R(x) = R (1 + change x), x = position of the breath in the recording, 0..1",
        parameters=(
            Parameter(
                "change", "1", "change from the first breath to the last, as a share of R",
                -0.8, 3.0, 0.0, 0.3, 0.6, share=True,
            ),
        ),
        source=(
            "Secretions, wet filters and bronchodilators change resistance by tens of percent "
            "(Bates, Lung Mechanics, Cambridge 2009); a hose that kinks does so at once."
        ),
        signature="An error that grows with flow and with the number of the breath.",
        confusable=("resistance_step", "compliance_drift", "sensor_drift"),
        detectable=None,
        least=0.05,
        least_reason="resistors repeat to a few percent",
    )  # fmt: skip

    uses_position = True

    def of_breath(self, values: Values, base: Values) -> Values:
        """R at the breath."""
        grown = 1.0 + values["change"] * base["position"]
        return {**base, "R": base["R"] * grown}


MECHANISM = ResistanceDrift()
