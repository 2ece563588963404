"""The valve's flow falls as the airway's pressure rises: the supply's pressure is finite."""

import jax.numpy as jnp

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View

#: Pressure at the airway for which the lost share of the flow is given, cmH2O.
REFERENCE = 30.0

#: Shares of the supply's pressure across the valve between which the orifice's law is used. Outside
#: (an airway near the supply's pressure, or far below the atmosphere's) the flow stays as it is.
_LEAST, _MOST = 0.02, 2.0


class SupplyPressure(Mechanism):
    """Flow through an orifice between a supply of some pressure and the airway."""

    description = Description(
        name="supply_pressure", title="valve flow that falls with airway pressure",
        site="inspiratory valve",
        equation=(
            "q = q_valve sqrt(1 - p / S), S = 30 cmH2O / (1 - (1 - loss)^2), the supply's pressure"
        ),
        parameters=(
            Parameter("loss", "1", "share of the flow that is lost against 30 cmH2O",
                      0.0, 0.7, 0.0, 0.13, 0.24, share=True),
        ),
        source="Incompressible orifice: flow grows with the root of the pressure drop. Blowers and "
        "low-pressure supplies give 40 to 200 cmH2O; 120 and 70 cmH2O lose 13 and 24 % against 30 "
        "cmH2O. Sonic valves behind wall supplies lose nothing.",
        signature="Too little flow at high airway pressure, whatever the command: late in "
        "inspiration and in big breaths, without any memory.",
        confusable=("leak", "supply_droop", "valve_curve", "nonlinear_compliance"), least=0.04,
        least_reason="a supply of 380 cmH2O; valves hold their flow to a few percent",
    )  # fmt: skip

    #: After everything that changes the flow itself.
    rank = 4

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the flow at the last pressure."""
        per_pressure = (1.0 - (1.0 - values["loss"]) ** 2) / REFERENCE  # 1 / S
        across = 1.0 - per_pressure * view.pressure
        share = jnp.sqrt(jnp.clip(across, _LEAST, _MOST))
        inside = (across > _LEAST) & (across < _MOST)
        falls = jnp.where(inside, 0.5 * per_pressure * network.inflow / share, 0.0)
        flow = network.inflow * share
        return network.plus(
            inflow=flow - network.inflow, leak=falls, leak_flow=-falls * view.pressure
        )
