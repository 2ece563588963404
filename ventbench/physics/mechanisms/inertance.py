"""Gas has mass, and the tubing before it takes up gas."""

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View

#: Inertance, cmH2O s2/L, at which half of the tubing's compliance acts, so that none acts without
#: inertance.
_HALF = 0.003


class Inertance(Mechanism):
    """Pressure needed to accelerate the flow into the lung, behind a compliant tube.

    Without a compliance at the airway, inertance acts on edges alone. With one, as in every real
    circuit, flow and pressure ring after each edge.
    """

    description = Description(
        name="inertance", title="inertance of the gas", site="airway",
        equation="p = ... + inertance dQ/dt, tubing inertance / (inertance + 0.003) dp/dt = q_in - "
        "Q - q_out",
        parameters=(
            Parameter("inertance", "cmH2O s2/L", "of gas in airway and tubing",
                      0.0, 0.4, 0.0, 0.04, 0.1),
            Parameter("tubing", "mL/cmH2O", "compliance of the circuit before it",
                      0.0, 1.2, 0.0, 0.3, 0.5, grid=(0.0, 0.15, 0.4, 0.8)),
        ),
        source="Mass of the gas in airway and tubing, 0.01 to 0.02 cmH2O s2/L in adults (Bates, "
        "Lung Mechanics, Cambridge 2009), behind 0.1 to 1 mL/cmH2O of tubing.",
        signature="Overshoot and ringing after edges, above all at the start of expiration with "
        "low R; below 0.15 cmH2O s2/L without tubing invisible at 30 samples a second.",
        confusable=("circuit_compliance", "exhalation_valve_delay"), detectable=0.16, least=0.008,
        least_reason="less than the gas in a tracheal tube alone",
    )  # fmt: skip

    # With tubing it rings at 20 Hz: at 7 ms a step, a fit finds 15 to 50 % too little of it.
    divisions = 4

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the inertance in series with the airway, and the tubing before it."""
        inertance = values["inertance"]
        tubing = 1e-3 * values["tubing"] * inertance / (inertance + _HALF)
        return network.plus(inertance=inertance, circuit=tubing)
