"""What happens to a circuit in operation, with the interface of the mechanisms of the library.

Diagnoses search for those that act in some breaths; stress tests and whoever names their parameters
use all of them.
"""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Mechanism, Network, Parameter, Values, View
from ventbench.physics.mechanisms.circuit import Leak, ReliefLeak

_LOST_SOURCE = (
    "Messages on a bus are lost, or come late and are overtaken (J. Nilsson, Real-Time "
    "Control Systems with Delays, Lund 1998)."
)


class LostCommands(Mechanism):
    """Commands that never come: the valve keeps the one before.

    Which ones, no parameter says, nor of :class:`LateCommands`: models follow the commands that
    reached the valve (:mod:`ventbench.diagnosis.in_time` finds them).
    """

    description = Description(
        name="lost_commands",
        title="commands that never reach the valve",
        site="command",
        equation="u_k = u_(k-1) where command k is lost",
        parameters=(
            Parameter("share", "1", "of the commands", 0.0, 1.0, 0.0, 0.06, 0.15, share=True),
        ),
        source=_LOST_SOURCE,
        signature="At single edges of the command, pressure answers a sample late.",
        confusable=("late_commands", "valve_delay"),
    )


class LateCommands(Mechanism):
    """Commands that come late, and act only if no later one has come before."""

    description = Description(
        name="late_commands",
        title="commands that reach the valve late",
        site="command",
        equation="command k comes at t_k + delay, and is dropped if a later one has come",
        parameters=(
            Parameter("share", "1", "of the commands", 0.0, 1.0, 0.0, 0.12, 0.3, share=True),
            Parameter("delay", "s", "of these commands", 0.0, 1.0, 0.1, 0.1, 0.1),
        ),
        source=_LOST_SOURCE,
        signature="As of lost commands; where several follow each other, an old one comes at last.",
        confusable=("lost_commands", "valve_delay"),
    )


class Cough(Mechanism):
    """A short push of the expiratory muscles: half a sine of pressure at the alveolus."""

    description = Description(
        name="cough",
        title="cough",
        site="alveolus",
        equation="P_alveolus = ... + pressure sin(pi (t - onset) / duration) while it lasts",
        parameters=(
            Parameter(
                "pressure",
                "cmH2O",
                "highest pressure of the muscles",
                0.0,
                100.0,
                0.0,
                5.0,
                15.0,
                scope="breath",
                scan=(3.0, 6.0, 12.0, 24.0),
            ),
            Parameter(
                "onset",
                "s",
                "after the first sample",
                0.0,
                3.0,
                0.3,
                0.3,
                0.3,
                scope="breath",
                grid=tuple(0.1 * k for k in range(19)),
            ),
            Parameter(
                "duration",
                "s",
                "of the push",
                0.05,
                0.5,
                0.2,
                0.2,
                0.2,
                scope="breath",
                grid=(0.14, 0.25),
            ),
        ),
        source="A cough lasts 0.2 to 0.5 s and raises the pressure in the chest by 5 to 100 cmH2O "
        "(J. G. Widdicombe, Eur. Respir. J. 8, 1995, 1193).",
        signature="A short hump of pressure in some breaths, at any time.",
        confusable=("patient_effort",),
        least=1.0,
        least_reason="less than the beating of a heart and the noise of a sensor",
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the push to the recoil."""
        phase = jnp.clip((view.time - values["onset"]) / values["duration"], 0.0, 1.0)
        return network.plus(recoil=values["pressure"] * jnp.sin(jnp.pi * phase))


class Disconnection(Mechanism):
    """The circuit comes off and is put back: an open tube beside the lung."""

    description = Description(
        name="disconnection",
        title="circuit open to the room",
        site="circuit",
        equation="q_out = conductance p while onset < t <= onset + duration",
        parameters=(
            Parameter(
                "conductance",
                "mL/s per cmH2O",
                "of the open end",
                0.0,
                5000.0,
                0.0,
                1000.0,
                1000.0,
                scope="breath",
                scan=(80.0, 150.0, 300.0, 1000.0),
            ),
            Parameter(
                "onset",
                "s",
                "after the first sample",
                -1.0,
                5.0,
                0.0,
                0.3,
                0.3,
                scope="breath",
                grid=tuple(0.1 * k for k in range(16)),
            ),
            Parameter(
                "duration",
                "s",
                "until it is put back",
                0.0,
                10.0,
                0.3,
                0.3,
                1.0,
                scope="breath",
                grid=(0.15, 0.25, 0.35, 0.5, 1.0, 10.0),
            ),
        ),
        source="An open adult tube of 22 mm drops about 1 cmH2O at 1 L/s; the lung and the valve "
        "both empty into the room.",
        signature="Pressure falls to that of the room at once and rises again from there.",
        confusable=("leak",),
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the open end as a conductance."""
        since = view.time - values["onset"]
        off = (since > 0.0) & (since <= values["duration"])
        return network.plus(leak=1e-3 * jnp.where(off, values["conductance"], 0.0))


class IntermittentLeak(Leak):
    """A leak that opens and seals between breaths, as a cuff or a mask that moves."""

    description = Description(
        name="intermittent_leak",
        title="leak in some breaths",
        site="circuit",
        equation=Leak.description.equation,
        parameters=(
            Parameter(
                "conductance",
                "mL/s",
                "leak at 1 cmH2O",
                -20.0,
                100.0,
                0.0,
                8.0,
                20.0,
                scope="breath",
                scan=(2.0, 3.0, 4.5, 7.0, 10.0, 15.0, 22.0, 33.0, 50.0),
            ),
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
            ),
        ),
        source="Cuffs and masks lose 5 to 50 mL/s per root of a cmH2O when a patient moves.",
        signature="In some breaths pressure is lost, most in long and high ones.",
        confusable=("leak", "secretions"),
        least=Leak.description.least,
        least_reason=Leak.description.least_reason,
    )


class ReliefValve(ReliefLeak):
    """A flow out of the circuit above a set, high pressure."""

    description = Description(
        name="relief_valve",
        title="relief valve of the circuit",
        site="circuit",
        equation="q_out = conductance max(p - opening, 0)",
        parameters=(
            Parameter(
                "conductance", "mL/s per cmH2O", "of the open valve", 0.0, 2000.0, 0.0, 200.0, 400.0
            ),
            Parameter("opening", "cmH2O", "where it opens", 20.0, 120.0, 60.0, 60.0, 60.0),
        ),
        source="Ventilators limit the pressure of the circuit by a spring-loaded valve, at 60 to "
        "80 cmH2O; no recording of the PVP goes above 61.4.",
        signature="Pressure does not rise above the opening pressure, whatever the command.",
        confusable=("leak",),
    )


class Secretions(Mechanism):
    """A resistance that is higher while fluid lies in the airway."""

    description = Description(
        name="secretions",
        title="resistance that is higher in some breaths",
        site="airway",
        equation="R = R (1 + increase)",
        parameters=(
            Parameter(
                "increase",
                "1",
                "of R in a breath, as a share",
                -0.7,
                10.0,
                0.0,
                0.5,
                1.2,
                scope="breath",
                share=True,
                scan=(0.15, 0.25, 0.4, 0.65, 1.0, 1.6, 2.5),
            ),
        ),
        source="Secretions raise resistance by tens of percent until they are sucked off or "
        "coughed up, and make flow rattle (A. Jubran, M. J. Tobin, Am. J. Respir. Crit. Care Med. "
        "150, 1994, 766).",
        signature="In some breaths an error that grows with flow.",
        confusable=("resistance_step", "intermittent_leak"),
        least=0.05,
        least_reason="resistors repeat to a few percent",
    )

    def of_breath(self, values: Values, base: Values) -> Values:
        """R at the breath."""
        return {**base, "R": base["R"] * (1.0 + values["increase"])}


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

    def network(self, values: Values, network: Network, view: View) -> Network:
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
        source="Condensed water makes flow and pressure saw (A. Jubran, M. J. Tobin, Am. J. "
        "Respir. Crit. Care Med. 150, 1994, 766).",
        signature="An oscillation of the pressure while gas flows, inwards or outwards.",
        confusable=("supply_ripple",),
    )

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Add the swing to the pressure between airway and lung."""
        flow = jnp.abs(view.flow)
        size = values["amplitude"] * flow / (flow + HALF_SWING)
        return network.plus(recoil=size * _sine(values, view))
