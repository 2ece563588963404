"""The inspiratory valve gives another flow from a breath on."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.parameters import Parameter
from ventbench.physics.session import AT, stepped


class GainStep(Mechanism):
    """A gain of the valve that changes between two breaths."""

    description = Description(
        name="gain_step",
        title="step of the valve's gain",
        site="inspiratory valve",
        equation="q = gain (1 + change) u_in after the position `at` of the recording",
        parameters=(
            Parameter(
                "change", "1", "change, as a share of the gain before",
                -0.6, 1.5, 0.0, 0.15, 0.3, scan=(0.15, -0.15), share=True,
            ),
            AT,
        ),
        source=(
            "A regulator that is set anew, a bottle that is changed, a filter that clogs, or a "
            "driver that is calibrated between two breaths."
        ),
        signature=(
            "From one breath on, all that the valve delivers is larger by one factor."
        ),
        confusable=("gain_drift", "compliance_step", "resistance_step"),
        detectable=None,
        least=0.03,
        least_reason="regulators hold their pressure to a few percent",
    )  # fmt: skip

    uses_position = True

    def of_breath(self, values: Values, base: Values) -> Values:
        """Gain at the breath."""
        changed = 1.0 + stepped(values, base["position"])
        return {**base, "gain": base["gain"] * changed}


MECHANISM = GainStep()
