"""Gas has mass."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.network import PneumaticNetwork, View
from ventbench.physics.parameters import Parameter


class Inertance(Mechanism):
    """Pressure needed to accelerate the flow into the lung."""

    description = Description(
        name="inertance",
        title="inertance of the gas",
        site="airway",
        equation="p = ... + inertance dQ/dt",
        parameters=(
            Parameter(
                "inertance", "cmH2O s2/L", "of gas in airway and tubing", 0.0, 0.4, 0.0, 0.04, 0.1
            ),
        ),
        source=(
            "Mass of the gas in airway and tubing, 0.01 to 0.02 cmH2O s2/L in adults "
            "(Bates, Lung Mechanics, Cambridge 2009)."
        ),
        signature=(
            "Overshoot after edges, above all at the start of expiration with low R; below "
            "0.15 cmH2O s2/L invisible at 30 samples a second."
        ),
        confusable=("circuit_compliance", "exhalation_valve_delay"),
        detectable=0.16,
        least=0.008,
        least_reason="less than the gas in a tracheal tube alone",
    )

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Add the inertance in series with the airway."""
        return network.plus(inertance=values["inertance"])


MECHANISM = Inertance()
