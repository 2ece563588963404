"""Flow of the inspiratory valve is not proportional to the command."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Parameter, Values


class ValveCurve(Mechanism):
    """Saturating or convex curve of the valve, linear at small commands."""

    description = Description(
        name="valve_curve", title="curve of the inspiratory valve", site="inspiratory valve",
        equation="q = gain u (1 + a x^m)^(-1/m), x = u / 100, a = (1 - loss)^-m - 1",
        parameters=(
            Parameter("loss", "1",
                      "share of the flow that is missing fully open; negative: flow gained",
                      -1.0, 0.95, 0.0, 0.2, 0.5, share=True),
            Parameter("power", "1", "m: 1 bends from the start, higher later",
                      0.5, 4.0, 1.0, 1.0, 1.0, shape=True, grid=(1.0, 3.0)),
        ),
        source="Flow through an orifice whose area is not proportional to the command, or whose "
        "pressure drop falls as flow rises; monotone for every loss and power. Public recordings "
        "of the PVP ask for a saturating curve in all nine lung settings.",
        signature="Error of one sign that grows with the command: during the first samples of "
        "inspiration, at high flow.",
        confusable=("turbulent_resistance", "supply_droop", "nonlinear_compliance"),
        detectable=0.015, least=0.04,
        least_reason="linearised valves hold their curve to a few percent",
        special_case_of=("valve_shape",),
    )  # fmt: skip

    rank = 3

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Command of a linear valve with the same flow."""
        # Above zero, where the derivative by the power is finite.
        x = jnp.clip(jnp.abs(u_in) * 0.01, 1e-6, 1.0)
        bend = (1.0 - values["loss"]) ** -values["power"] - 1.0
        return u_in * (1.0 + bend * x ** values["power"]) ** (-1.0 / values["power"]), memory
