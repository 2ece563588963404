"""What swings by itself: the pressure of the supply, and water in a tube."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Values
from ventbench.physics.network import PneumaticNetwork, View
from ventbench.physics.parameters import Parameter

#: Flow at which water swings half as far as it can, L/s.
HALF_SWING = 0.1

_PHASE = Parameter(
    "phase", "1", "at the first sample, in periods", -1.0, 1.0, 0.0, 0.0, 0.0, scope="breath"
)


def _sine(values: Values, view: View) -> Array:
    return jnp.sin(2.0 * jnp.pi * (values["frequency"] * view.time + values["phase"]))


class SupplyRipple(Mechanism):
    """A flow of the supply that pulsates, whatever is commanded."""

    description = Description(
        name="supply_ripple",
        title="ripple of the supply",
        site="supply",
        equation="q = q (1 + amplitude sin(2 pi (frequency t + phase)))",
        parameters=(
            Parameter("amplitude", "1", "of the flow", 0.0, 1.0, 0.0, 0.1, 0.2, share=True),
            Parameter("frequency", "Hz", "of the ripple", 0.2, 30.0, 5.0, 5.0, 5.0),
            _PHASE,
        ),
        source="Pistons and blowers pulsate by a few percent (ISO 80601-2-12).",
        signature="An oscillation that grows with the commanded flow and ends with it.",
        confusable=("circuit_water",),
    )

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Add the ripple to the flow out of the inspiratory valve."""
        return network.plus(inflow=network.inflow * values["amplitude"] * _sine(values, view))


class CircuitWater(Mechanism):
    """Water in a tube, which gas that flows sets swinging."""

    description = Description(
        name="circuit_water",
        title="water that swings in a tube",
        site="circuit",
        equation="p = ... + amplitude |Q| / (|Q| + 0.1 L/s) sin(2 pi (frequency t + phase))",
        parameters=(
            Parameter("amplitude", "cmH2O", "at a large flow", 0.0, 20.0, 0.0, 0.7, 1.6),
            Parameter("frequency", "Hz", "of the swing", 0.2, 30.0, 5.0, 5.0, 5.0),
            _PHASE,
        ),
        source=(
            "Condensed water makes flow and pressure saw (A. Jubran, M. J. Tobin, Am. J. Respir. "
            "Crit. Care Med. 150, 1994, 766)."
        ),
        signature="An oscillation of the pressure while gas flows, inwards or outwards.",
        confusable=("supply_ripple",),
    )

    def network(self, values: Values, network: PneumaticNetwork, view: View) -> PneumaticNetwork:
        """Add the swing to the pressure between airway and lung."""
        flow = jnp.abs(view.flow)
        size = values["amplitude"] * flow / (flow + HALF_SWING)
        return network.plus(recoil=size * _sine(values, view))


MECHANISMS = (SupplyRipple(), CircuitWater())
