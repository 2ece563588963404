"""Gas leaves beside the lung."""

import jax.numpy as jnp

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View

#: The root is rounded off below this pressure, cmH2O, where its slope would be infinite.
_ROUND = 0.2


class Leak(Mechanism):
    """A flow out of the airway that grows with its pressure."""

    description = Description(
        name="leak", title="leak at the airway", site="circuit",
        equation="q_leak = conductance p (p^2 + e^2)^((exponent - 1) / 2), e = 0.2 cmH2O",
        parameters=(
            Parameter("conductance", "mL/s", "leak at 1 cmH2O", 0.0, 50.0, 0.0, 8.0, 20.0),
            Parameter("exponent", "1", "0.5 for an orifice, 1 for a narrow channel",
                      0.5, 1.0, 0.5, 0.5, 0.5, shape=True, grid=(0.5, 1.0)),
        ),
        source="Orifice flow grows with the root of pressure, laminar flow in proportion; 1 to 10 "
        "mL/s per cmH2O is a usual leak of masks and cuffs.",
        signature="Pressure is lost late in inspiration and most in long, high plateaus; nearly "
        "all of it can hide in R and C.",
        confusable=("viscoelasticity", "valve_dead_band", "supply_droop"), detectable=0.25,
        least=1.0, least_reason="less than connectors are allowed to leak",
        special_case_of=("leak_shape",),
    )  # fmt: skip

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the leak at the last pressure."""
        power = 0.5 * (values["exponent"] - 1.0)
        square = view.pressure**2 + _ROUND**2
        # As square**power, in half the time: a power is no vector code.
        scale = 1e-3 * values["conductance"] * jnp.exp(power * jnp.log(square))
        slope = scale * (1.0 + 2.0 * power * view.pressure**2 / square)
        return network.plus(leak=slope, leak_flow=(scale - slope) * view.pressure)
