"""Secretions narrow the airway in some breaths."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter


class Secretions(Mechanism):
    """A resistance that is higher while fluid lies in the airway."""

    description = Description(
        name="secretions",
        title="resistance that is higher in some breaths",
        site="airway",
        equation="R = R (1 + increase)",
        parameters=(
            Parameter(
                "increase", "1", "of R in a breath, as a share",
                -0.7, 10.0, 0.0, 0.5, 1.2, scope="breath", share=True,
                scan=(0.15, 0.25, 0.4, 0.65, 1.0, 1.6, 2.5),
            ),
        ),
        source=(
            "Secretions raise resistance by tens of percent until they are sucked off or coughed "
            "up, and make flow rattle (A. Jubran, M. J. Tobin, Am. J. Respir. Crit. Care Med. 150, "
            "1994, 766)."
        ),
        signature="In some breaths an error that grows with flow.",
        confusable=("resistance_step", "intermittent_leak"),
        least=0.05,
        least_reason="resistors repeat to a few percent",
    )  # fmt: skip

    def of_breath(self, values: Values, base: Values) -> Values:
        """R at the breath."""
        return {**base, "R": base["R"] * (1.0 + values["increase"])}


MECHANISM = Secretions()
