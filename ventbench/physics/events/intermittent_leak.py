"""Gas leaves beside the lung in some breaths."""

from __future__ import annotations

from ventbench.physics.mechanism import Description
from ventbench.physics.mechanisms.leak import Leak
from ventbench.physics.parameters import Parameter


class IntermittentLeak(Leak):
    """A leak that opens and seals between breaths, as a cuff or a mask that moves."""

    description = Description(
        name="intermittent_leak",
        title="leak in some breaths",
        site="circuit",
        equation="q_leak = conductance p (p^2 + e^2)^((exponent - 1) / 2), e = 0.2 cmH2O",
        parameters=(
            Parameter(
                "conductance", "mL/s", "leak at 1 cmH2O",
                -20.0, 100.0, 0.0, 8.0, 20.0, scope="breath",
                scan=(2.0, 3.0, 4.5, 7.0, 10.0, 15.0, 22.0, 33.0, 50.0),
            ),
            Parameter(
                "exponent", "1", "0.5 for an orifice, 1 for a narrow channel",
                0.5, 1.0, 0.5, 0.5, 0.5, shape=True,
            ),
        ),
        source="Cuffs and masks lose 5 to 50 mL/s per root of a cmH2O when a patient moves.",
        signature="In some breaths pressure is lost, most in long and high ones.",
        confusable=("leak", "secretions"),
        least=1.0,
        least_reason="less than connectors are allowed to leak",
    )  # fmt: skip


MECHANISM = IntermittentLeak()
