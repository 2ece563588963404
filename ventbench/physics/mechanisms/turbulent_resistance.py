"""Turbulence: the airway resists more at high flow."""

from __future__ import annotations

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.network import Network, View
from ventbench.physics.parameters import Parameter


class TurbulentResistance(Mechanism):
    """A pressure drop that grows with the square of flow."""

    description = Description(
        name="turbulent_resistance",
        title="resistance that grows with flow",
        site="airway",
        equation="p = ... + R Q + quadratic Q |Q|",
        parameters=(
            Parameter(
                "quadratic",
                "cmH2O s2/L2",
                "second coefficient of Rohrer",
                0.0,
                80.0,
                0.0,
                4.0,
                10.0,
                follows="R",
            ),
        ),
        source=(
            "Rohrer's equation (Otis, Fenn and Rahn, J. Appl. Physiol. 2, 1950, 592); "
            "parabolic resistors of test lungs hold their label at one flow only. 1 to 30 "
            "cmH2O s2/L2."
        ),
        signature=(
            "Pressure drop grows faster than flow: error at high flow, in inspiration and "
            "at the start of expiration, most in lungs with low R; fitted R falls below the "
            "label."
        ),
        confusable=("valve_curve",),
        detectable=0.5,
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add it to the airway."""
        return network.plus(quadratic=values["quadratic"])


MECHANISM = TurbulentResistance()
