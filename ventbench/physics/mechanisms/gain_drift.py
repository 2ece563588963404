"""The inspiratory valve's gain changes in the course of a recording."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter
from ventbench.physics.session import WARMING, grown


class GainDrift(Mechanism):
    """A gain of the valve that grows or falls with the number of the breath."""

    description = Description(
        name="gain_drift",
        title="drift of the valve's gain",
        site="inspiratory valve",
        equation=(
            "gain(x) = gain (1 + change g), g = (1 - exp(-warming x)) / (1 - exp(-warming)), "
            "x = position of the breath in the recording, 0..1"
        ),
        parameters=(
            Parameter(
                "change", "1", "change from the first breath to the last, as a share of the gain",
                -0.6, 1.5, 0.0, 0.15, 0.3, share=True,
            ),
            WARMING,
        ),
        source=(
            "Blowers and coils warm up within minutes and lose 5 to 20 % of their flow; a bottle "
            "empties steadily."
        ),
        signature=(
            "All that the valve delivers grows or falls with the number of the breath."
        ),
        confusable=("gain_step", "compliance_drift", "resistance_drift"),
        detectable=None,
        least=0.03,
        least_reason="regulators hold their pressure to a few percent",
    )  # fmt: skip

    uses_position = True

    def of_breath(self, values: Values, base: Values) -> Values:
        """Gain at the breath."""
        changed = 1.0 + values["change"] * grown(values, base["position"])
        return {**base, "gain": base["gain"] * changed}


MECHANISM = GainDrift()
