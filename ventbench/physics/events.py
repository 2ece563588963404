"""What happens to a circuit in operation, with the interface of the mechanisms of the library.

Diagnoses search for those that act in some breaths; stress tests and whoever names their parameters
use all of them.
"""

from dataclasses import replace

import jax.numpy as jnp
from jax import Array

from ventbench.base.files import data_beside
from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View
from ventbench.physics.mechanisms.circuit import ROUNDED, Leak, ReliefLeak

_EVENTS = data_beside(__file__, "events.toml")


def _described(name: str) -> Description:
    """What ``events.toml`` says of an event."""
    event = _EVENTS[name]
    parameters = tuple(Parameter(**row) for row in event["parameters"])
    return Description(**{**event, "name": name, "parameters": parameters})


class LostCommands(Mechanism):
    """Commands that never come: the valve keeps the one before.

    Which ones, no parameter says, nor of :class:`LateCommands`: models follow the commands that
    reached the valve (:mod:`ventbench.diagnosis.in_time` finds them).
    """

    description = _described("lost_commands")


class LateCommands(Mechanism):
    """Commands that come late, and act only if no later one has come before."""

    description = _described("late_commands")


class Cough(Mechanism):
    """A short push of the expiratory muscles: half a sine of pressure at the alveolus."""

    description = _described("cough")

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the push to the recoil."""
        phase = jnp.clip((view.time - values["onset"]) / values["duration"], 0.0, 1.0)
        return network.plus(recoil=values["pressure"] * jnp.sin(jnp.pi * phase))


class Disconnection(Mechanism):
    """The circuit comes off and is put back: an open tube beside the lung."""

    description = _described("disconnection")

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the open end as its conductance at the last pressure.

        A tangent there would take a jet far below the pressure of the room.
        """
        since = view.time - values["onset"]
        off = (since > 0.0) & (since <= values["duration"])
        power = 0.5 * (values["exponent"] - 1.0)
        share = jnp.exp(power * jnp.log(view.pressure**2 + ROUNDED**2))
        return network.plus(leak=1e-3 * jnp.where(off, values["conductance"], 0.0) * share)


class IntermittentLeak(Leak):
    """A leak that opens and seals between breaths, as a cuff or a mask that moves."""

    description = replace(
        _described("intermittent_leak"),
        equation=Leak.description.equation,
        least=Leak.description.least,
        least_reason=Leak.description.least_reason,
    )


class ReliefValve(ReliefLeak):
    """A flow out of the circuit above a set, high pressure."""

    description = _described("relief_valve")


class Secretions(Mechanism):
    """A resistance that is higher while fluid lies in the airway."""

    description = _described("secretions")

    def of_breath(self, values: Values, base: Values) -> Values:
        """R at the breath."""
        return {**base, "R": base["R"] * (1.0 + values["increase"])}


#: Flow at which water swings half as far as it can, L/s.
HALF_SWING = 0.1


def _sine(values: Values, view: View) -> Array:
    return jnp.sin(2.0 * jnp.pi * (values["frequency"] * view.time + values["phase"]))


class SupplyRipple(Mechanism):
    """A flow of the supply that pulsates, whatever is commanded."""

    description = _described("supply_ripple")

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the ripple to the flow out of the inspiratory valve."""
        return network.plus(inflow=network.inflow * values["amplitude"] * _sine(values, view))


class CircuitWater(Mechanism):
    """Water in a tube, which gas that flows sets swinging."""

    description = _described("circuit_water")

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the swing to the pressure between airway and lung."""
        flow = jnp.abs(view.flow)
        size = values["amplitude"] * flow / (flow + HALF_SWING)
        return network.plus(recoil=size * _sine(values, view))
