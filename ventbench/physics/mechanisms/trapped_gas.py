"""Breaths begin with gas that the last one has left."""

from ventbench.physics.mechanism import Description, Mechanism, Parameter, Values


class TrappedGas(Mechanism):
    """A pressure in the lung above that at the airway when a breath begins (auto-PEEP)."""

    description = Description(
        name="trapped_gas", title="trapped gas at the start of a breath", site="alveolus",
        equation="P_alveolus(0) = p(0) + pressure",
        parameters=(
            Parameter("pressure", "cmH2O", "excess in the lung at the first sample",
                      0.0, 10.0, 0.0, 1.5, 4.0),
        ),
        source="Expiration that ends before the lung is empty leaves 1 to 15 cmH2O (Pepe and "
        "Marini, Am. Rev. Respir. Dis. 126, 1982, 166).",
        signature=(
            "A breath begins above its first reading at once, and gas flows out before it is given."
        ),
        confusable=("leak", "zero_step"), least=0.3,
        least_reason="a valve that closes some milliseconds late",
    )  # fmt: skip

    def of_breath(self, values: Values, base: Values) -> Values:
        """Recoil above the pressure at the airway."""
        return {**base, "offset": base["offset"] + values["pressure"]}
