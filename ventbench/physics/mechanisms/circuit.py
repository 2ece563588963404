"""The supply and the circuit: flow that is not given, is taken up by the tubing, or leaves."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import (
    Description,
    Mechanism,
    Network,
    Pair,
    Parameter,
    Values,
    View,
)

#: Flow for which the lost share is given, L/s.
_DROOP_FLOW = 0.5

#: Least share of the flow that a supply gives.
_LEAST_FLOW = 0.02


class SupplyDroop(Mechanism):
    """Flow is reduced by what recent flow has cost the supply."""

    description = Description(
        name="supply_droop",
        title="supply that sags with recent flow",
        site="supply",
        equation="q = q_valve ((1 - linear) / (1 + k s) + linear (1 - drop s / 0.5)), recovery "
        "ds/dt = q - s, k = drop / (1 - drop) / 0.5",
        parameters=(
            Parameter(
                "drop",
                "1",
                "share of the flow that is lost at a lasting 0.5 L/s",
                0.0,
                0.7,
                0.0,
                0.1,
                0.3,
                share=True,
            ),
            Parameter(
                "recovery",
                "s",
                "time constant",
                0.1,
                5.0,
                1.0,
                1.0,
                1.0,
                "log",
                shape=True,
                uncertain=True,
            ),
            Parameter(
                "linear",
                "1",
                "1 where the loss grows with recent flow as a regulator's does, 0 where it "
                "levels off",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 1.0),
            ),
        ),
        source="Reservoir behind a regulator or blower: its pressure falls with the flow drawn "
        "from it and recovers in about a second. A regulator's pressure falls in proportion to the "
        "flow (ISO 6953), and the flow of a sonic valve in proportion to that pressure (ISO 6358).",
        signature="Flow is lost late in inspiration and in big breaths; after a pause it is back.",
        confusable=("valve_curve", "leak", "viscoelasticity"),
        least=0.03,
        least_reason="regulators hold their pressure to a few percent",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
    )

    rank = 1
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Recent flow, L/s."""
        return flow

    def inflow(self, values: Values, flow: Array, state: Array, length: Array) -> Pair:
        """Flow that the supply can give; recent flow is predicted, then corrected."""
        time = values["recovery"]
        ahead = (time * state + _delivered(values, length * flow, state)) / (time + length)
        delivered = _delivered(values, flow, ahead)
        return delivered, (time * state + length * delivered) / (time + length)


def _delivered(values: Values, flow: Array, recent: Array) -> Array:
    """What a supply gives of a flow, L/s, after a recent flow, L/s."""
    drop, linear = values["drop"], values["linear"]
    levelling = flow / (1.0 + drop / (1.0 - drop) / _DROOP_FLOW * recent)
    proportional = flow * jnp.maximum(1.0 - drop / _DROOP_FLOW * recent, _LEAST_FLOW)
    return (1.0 - linear) * levelling + linear * proportional


#: Pressure at the airway for which the lost share of the flow is given, cmH2O.
_LOSS_PRESSURE = 30.0

#: Shares of the supply's pressure across the valve between which the orifice's law is used. Outside
#: (an airway near the supply's pressure, or far below the atmosphere's) the flow stays as it is.
_LEAST, _MOST = 0.02, 2.0


class SupplyPressure(Mechanism):
    """Flow through an orifice between a supply of some pressure and the airway."""

    description = Description(
        name="supply_pressure",
        title="valve flow that falls with airway pressure",
        site="inspiratory valve",
        equation=(
            "q = q_valve sqrt(1 - p / S), S = 30 cmH2O / (1 - (1 - loss)^2), the supply's pressure"
        ),
        parameters=(
            Parameter(
                "loss",
                "1",
                "share of the flow that is lost against 30 cmH2O",
                0.0,
                0.7,
                0.0,
                0.13,
                0.24,
                share=True,
            ),
        ),
        source="Incompressible orifice: flow grows with the root of the pressure drop. Blowers and "
        "low-pressure supplies give 40 to 200 cmH2O; 120 and 70 cmH2O lose 13 and 24 % against 30 "
        "cmH2O. Sonic valves behind wall supplies lose nothing.",
        signature="Too little flow at high airway pressure, whatever the command: late in "
        "inspiration and in big breaths, without any memory.",
        confusable=("leak", "supply_droop", "valve_curve", "nonlinear_compliance"),
        least=0.04,
        least_reason="a supply of 380 cmH2O; valves hold their flow to a few percent",
    )

    #: After everything that changes the flow itself.
    rank = 4

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the flow at the last pressure."""
        per_pressure = (1.0 - (1.0 - values["loss"]) ** 2) / _LOSS_PRESSURE  # 1 / S
        across = 1.0 - per_pressure * view.pressure
        share = jnp.sqrt(jnp.clip(across, _LEAST, _MOST))
        inside = (across > _LEAST) & (across < _MOST)
        falls = jnp.where(inside, 0.5 * per_pressure * network.inflow / share, 0.0)
        flow = network.inflow * share
        return network.plus(
            inflow=flow - network.inflow, leak=falls, leak_flow=-falls * view.pressure
        )


class CircuitCompliance(Mechanism):
    """A compliance at the airway, in parallel to the lung."""

    description = Description(
        name="circuit_compliance",
        title="compliance of the circuit",
        site="circuit",
        equation="C_circuit dp/dt = q_in - q_lung - q_out",
        parameters=(
            Parameter(
                "compliance",
                "mL/cmH2O",
                "of tubing, humidifier and dead space",
                0.0,
                10.0,
                0.0,
                1.2,
                3.0,
            ),
        ),
        source=(
            "Gas that stays in the tubing as pressure rises; 0.5 to 3 mL/cmH2O for adult circuits."
        ),
        signature="Edges of pressure are rounded, the more the higher R, in inspiration and at the "
        "start of expiration.",
        confusable=("valve_lag", "sensor_lag"),
        least=0.3,
        least_reason="a syringe's worth of tubing; less moves no edge of 30 samples a second",
        ubiquitous=True,
    )

    # Behind 5 cmH2O/(L/s) it fills within 15 ms: at 7 ms a step, a fit finds 3 % too much of it.
    divisions = 2

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the circuit's compliance beside the lung."""
        return network.plus(circuit=1e-3 * values["compliance"])


#: The root is rounded off below this pressure, cmH2O, where its slope would be infinite.
ROUNDED = 0.2


class Leak(Mechanism):
    """A flow out of the airway that grows with its pressure."""

    description = Description(
        name="leak",
        title="leak at the airway",
        site="circuit",
        equation="q_leak = conductance p (p^2 + e^2)^((exponent - 1) / 2), e = 0.2 cmH2O",
        parameters=(
            Parameter("conductance", "mL/s", "leak at 1 cmH2O", 0.0, 50.0, 0.0, 8.0, 20.0),
            Parameter(
                "exponent",
                "1",
                "0.5 for an orifice, 1 for a narrow channel",
                0.5,
                1.0,
                0.5,
                0.5,
                0.5,
                shape=True,
                grid=(0.5, 1.0),
            ),
        ),
        source="Orifice flow grows with the root of pressure, laminar flow in proportion; 1 to 10 "
        "mL/s per cmH2O is a usual leak of masks and cuffs.",
        signature="Pressure is lost late in inspiration and most in long, high plateaus; nearly "
        "all of it can hide in R and C.",
        confusable=("viscoelasticity", "valve_dead_band", "supply_droop"),
        least=1.0,
        least_reason="less than connectors are allowed to leak",
        special_case_of=("leak_shape",),
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent of the leak at the last pressure."""
        power = 0.5 * (values["exponent"] - 1.0)
        square = view.pressure**2 + ROUNDED**2
        # As square**power, in half the time: a power is no vector code.
        scale = 1e-3 * values["conductance"] * jnp.exp(power * jnp.log(square))
        slope = scale * (1.0 + 2.0 * power * view.pressure**2 / square)
        return network.plus(leak=slope, leak_flow=(scale - slope) * view.pressure)


class ReliefLeak(Mechanism):
    """A leak that opens at a pressure, as a valve with a weak spring or a mask that lifts."""

    description = Description(
        name="relief_leak",
        title="leak above a pressure",
        site="circuit",
        equation="q_leak = conductance max(p - opening, 0)",
        parameters=(
            Parameter(
                "conductance",
                "mL/s per cmH2O",
                "above the opening pressure",
                0.0,
                100.0,
                0.0,
                8.0,
                25.0,
            ),
            Parameter(
                "opening",
                "cmH2O",
                "pressure at which it opens",
                3.0,
                60.0,
                15.0,
                15.0,
                15.0,
                grid=(10.0, 15.0, 20.0, 28.0),
            ),
        ),
        source="Relief valves and masks lift at 10 to 40 cmH2O; a cuff seals up to its own "
        "pressure of 20 to 30 cmH2O.",
        signature="Pressure is cut off above a pressure, and as usual below.",
        confusable=("leak", "supply_pressure", "nonlinear_compliance"),
        least=1.0,
        least_reason="less than connectors are allowed to leak",
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Tangent at the last pressure."""
        slope = 1e-3 * values["conductance"] * (view.pressure > values["opening"])
        return network.plus(leak=slope, leak_flow=-slope * values["opening"])
