"""Gas leaves beside the lung above a pressure."""

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View


class ReliefLeak(Mechanism):
    """A leak that opens at a pressure, as a valve with a weak spring or a mask that lifts."""

    description = Description(
        name="relief_leak", title="leak above a pressure", site="circuit",
        equation="q_leak = conductance max(p - opening, 0)",
        parameters=(
            Parameter("conductance", "mL/s per cmH2O", "above the opening pressure",
                      0.0, 100.0, 0.0, 8.0, 25.0),
            Parameter("opening", "cmH2O", "pressure at which it opens",
                      3.0, 60.0, 15.0, 15.0, 15.0, grid=(10.0, 15.0, 20.0, 28.0)),
        ),
        source="Relief valves and masks lift at 10 to 40 cmH2O; a cuff seals up to its own "
        "pressure of 20 to 30 cmH2O.",
        signature="Pressure is cut off above a pressure, and as usual below.",
        confusable=("leak", "supply_pressure", "nonlinear_compliance"), least=1.0,
        least_reason="less than connectors are allowed to leak",
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent at the last pressure."""
        slope = 1e-3 * values["conductance"] * (view.pressure > values["opening"])
        return network.plus(leak=slope, leak_flow=-slope * values["opening"])
