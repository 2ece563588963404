"""Turbulence: the airway resists more at high flow."""

import jax.numpy as jnp

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View

#: The slope of the power by flow is rounded off below this flow, L/s.
_ROUND = 0.02


class TurbulentResistance(Mechanism):
    """A pressure drop that grows with the square of flow, or nearly."""

    description = Description(
        name="turbulent_resistance", title="resistance that grows with flow", site="airway",
        equation="p = ... + R Q + quadratic Q |Q| (Q^2 + e^2)^(exponent / 2 - 1), e = 0.02 L/s",
        parameters=(
            Parameter("quadratic", "cmH2O s2/L2", "second coefficient of Rohrer; drop at 1 L/s",
                      0.0, 80.0, 0.0, 4.0, 10.0, follows="R"),
            Parameter("exponent", "1", "2 for an orifice, 1.75 for a smooth tube",
                      1.5, 2.0, 2.0, 2.0, 2.0, shape=True),
        ),
        source="Rohrer's equation (Otis, Fenn and Rahn, J. Appl. Physiol. 2, 1950, 592); parabolic "
        "resistors of test lungs hold their label at one flow only. 1 to 30 cmH2O s2/L2. In a "
        "smooth tube the exponent is 1.75 (Blasius).",
        signature="Pressure drop grows faster than flow: error at high flow, in inspiration and at "
        "the start of expiration, most in lungs with low R; fitted R falls below the label.",
        confusable=("valve_curve",), detectable=0.5, least=1.0,
        least_reason="the curvature of a straight tracheal tube; less is within R",
        special_case_of=("flow_shape",),
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the resistance; the part that differs from a square is taken at the last flow."""
        milder = jnp.log(view.flow**2 + _ROUND**2) * (0.5 * values["exponent"] - 1.0)
        return network.plus(quadratic=values["quadratic"] * jnp.exp(milder))
