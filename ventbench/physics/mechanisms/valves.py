"""The valves: what the driver passes, play, dead band, delay, lag and curve, and the outlet."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.mechanism import (
    VALVE_GAIN,
    Description,
    Mechanism,
    Network,
    Pair,
    Parameter,
    Values,
    View,
)

#: Steps of a valve, %: whole percents, and others so close to each other that the largest usual
#: commands, of about 60 %, are off by a quarter of a step between two of them.
_POSITIONS = tuple(np.exp(0.008 * np.arange(-87, 202)).tolist())


class CommandRounding(Mechanism):
    """A valve that moves in whole steps behind a logged fractional command."""

    description = Description(
        name="command_rounding",
        title="command rounded to whole steps",
        site="command",
        equation="u_effective = u + amount (step floor(u / step + bias) - u)",
        parameters=(
            Parameter(
                "amount",
                "1",
                "share of the rounding that is seen: 1 if the valve gets whole steps",
                0.0,
                1.0,
                0.0,
                1.0,
                1.0,
            ),
            Parameter(
                "bias",
                "%",
                "0 cuts off, 0.5 rounds to the nearest; no derivative: try both",
                0.0,
                0.5,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 0.5),
                discrete=True,
            ),
            Parameter(
                "step",
                "%",
                "distance between the positions of the valve",
                0.1,
                10.0,
                1.0,
                1.0,
                2.0,
                "log",
                shape=True,
                grid=_POSITIONS,
                discrete=True,
                screened=True,
            ),
        ),
        source="Valve drivers that take integers, and stepping motors, while the controller logs "
        "its fractional request; ISA-75.25: resolution of control valves.",
        signature="Cut off, half a step of the command is missing on average, which looks like "
        "a dead band; what remains follows the place of each command between two steps.",
        confusable=("valve_dead_band",),
        least=0.5,
        least_reason="a driver rounds or does not; half a rounding is another effect",
        special_case_of=("valve_shape",),
    )

    def driven(self, values: Values, u_in: Array) -> Array:
        """The command, moved towards a whole step."""
        step = values["step"]
        rounded = step * jnp.floor(u_in / step + values["bias"])
        return u_in + values["amount"] * (rounded - u_in)


#: Travel in which a stuck seat lets go, as a share of the band: short, but with a slope by which a
#: fit finds the width.
_LETS_GO = 0.2

#: Width, %, so that none is no division by zero.
_THIN = 1e-6


class ValveDeadBand(Mechanism):
    """The first part of the stroke gives no flow."""

    description = Description(
        name="valve_dead_band",
        title="dead band of the inspiratory valve",
        site="inspiratory valve",
        equation="u_effective = 0 below width, u - (1 - crack) width above",
        parameters=(
            Parameter("width", "%", "command at which flow begins", 0.0, 10.0, 0.0, 1.5, 3.5),
            Parameter(
                "crack",
                "1",
                "0 for overlap, which every command loses; 1 for a stuck seat that cracks open",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 1.0),
            ),
            Parameter(
                "driver",
                "1",
                "share of the width that is lost before the valve's play, not behind it: 0 "
                "for overlap of the seat, 1 for a driver with a least command",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 1.0),
            ),
        ),
        source="Overlap of the spool or friction of the seat; 0 to 5 % of the stroke is usual "
        "without linearisation (ISA-75.25: dead band and resolution of control valves).",
        signature="Too little flow at every small command, none at the smallest: late in "
        "inspiration, and in lungs with high R and low C, which are ventilated with small "
        "commands.",
        confusable=("leak", "command_rounding", "valve_hysteresis"),
        least=0.25,
        least_reason="a quarter of a percent of stroke, the resolution of drivers",
        special_case_of=("valve_shape",),
    )

    rank = 2

    def driven(self, values: Values, u_in: Array) -> Array:
        """Remainder of the command behind the driver."""
        return _remainder(values, u_in, values["driver"] * values["width"])

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Remainder of the command; a negative one is not a valve's and passes."""
        return _remainder(values, u_in, (1.0 - values["driver"]) * values["width"]), memory


def _remainder(values: Values, u_in: Array, width: Array) -> Array:
    """What a dead band of some width, %, leaves of a command, %."""
    positive = jnp.maximum(u_in, 0.0)
    lost = jnp.minimum(positive, width)
    free = jnp.clip(0.5 + (positive - width) / (_LETS_GO * width + _THIN), 0.0, 1.0)
    stuck = positive * (1.0 - free)
    return u_in - lost - values["crack"] * (stuck - lost)


class ValveHysteresis(Mechanism):
    """Rate-independent memory of the command."""

    description = Description(
        name="valve_hysteresis",
        title="play of the inspiratory valve",
        site="inspiratory valve",
        equation="u_effective = u - h z, h = width / 2, z = (1 - smooth) ((1 - give) clip(x, -1, "
        "1) + give tanh x) + smooth (s + (z before - s) exp(-|d| / h)), x = z before + d / h, d = "
        "u - u before, s = sign d",
        parameters=(
            Parameter("width", "%", "command lost at every reversal", 0.0, 15.0, 0.0, 2.0, 5.0),
            Parameter(
                "give",
                "1",
                "0 for slack, 1 for a drive that gives before it moves the seat",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
            ),
            Parameter(
                "smooth",
                "1",
                "1 for a lag that nears its width exponentially with the travel",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 1.0),
            ),
        ),
        source="Play (backlash) operator: friction and slack between driver and seat, or opening "
        "and closing tables that differ. 3.8 % of full scale was measured on the PVP's valve. With "
        "smooth 1 the hysteresis of Bouc (1967) and Wen (J. Eng. Mech. 102, 1976, 249), whose "
        "memory is that of the travel, not of time.",
        signature="After each reversal of the command flow stays where it was; error of one sign "
        "while the command rises and of the other while it falls.",
        confusable=("valve_dead_band", "valve_delay"),
        least=0.3,
        least_reason="a little more than the resolution of drivers",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
    )

    rank = 1
    has_memory = True

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Position of the valve, %; the memory is that and the command, ``(2, ...)``."""
        half = 0.5 * values["width"]
        position, before = jnp.broadcast_to(memory, (2, *u_in.shape))
        hard = jnp.minimum(jnp.maximum(position, u_in - half), u_in + half)
        soft = u_in - half * jnp.tanh((u_in - position) / (half + _THIN))
        yielding = hard + values["give"] * (soft - hard)
        travel = u_in - before
        full = half * jnp.sign(travel)
        decay = jnp.exp(-jnp.abs(travel) / (half + _THIN))
        gradual = u_in - full - (before - position - full) * decay
        position = yielding + values["smooth"] * (gradual - yielding)
        return position, jnp.stack([position, u_in])


class ValveDelay(Mechanism):
    """Command of the inspiratory valve, shifted in time."""

    description = Description(
        name="valve_delay",
        title="dead time of the inspiratory valve",
        site="inspiratory valve",
        equation="q(t) = q_commanded(t - delay)",
        parameters=(
            Parameter(
                "delay",
                "s",
                "dead time",
                0.0,
                0.15,
                0.0,
                0.04,
                0.08,
                scan=tuple(0.01 * k for k in range(16)),
                kinked=True,
            ),
        ),
        source="Pure transport delay of driver, pilot and tubing; proportional valves of "
        "ventilators answer after 10 to 100 ms, and a delay of one to three samples is what fits "
        "of recorded breaths ask for.",
        signature="Pressure runs ahead of the recording after every edge of the command during "
        "inspiration, by one constant time.",
        confusable=("valve_lag", "sensor_lag", "circuit_compliance"),
        least=0.008,
        least_reason="a quarter of a sample: less is the clock's, not the valve's",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
    )

    def dead_time(self, values: Values, time: Array) -> Array:
        """The delay, s."""
        return values["delay"]


class ValveLag(Mechanism):
    """Flow of the valve follows the commanded flow through one lag or two."""

    description = Description(
        name="valve_lag",
        title="lag of the inspiratory valve",
        site="inspiratory valve",
        equation="tau dx/dt = q_commanded - x, second dq/dt = x - q",
        parameters=(
            Parameter("tau", "s", "time constant", 0.0, 0.2, 0.0, 0.04, 0.1),
            Parameter(
                "second",
                "s",
                "time constant of a lag behind the first, as of a pilot stage",
                0.0,
                0.2,
                0.0,
                0.0,
                0.0,
                shape=True,
            ),
        ),
        source="First-order actuator; time constants of 5 to 100 ms are usual for proportional "
        "solenoid valves.",
        signature="Edges of the command arrive rounded during inspiration; the start of expiration "
        "is not affected.",
        confusable=("sensor_lag", "circuit_compliance", "valve_delay"),
        least=0.008,
        least_reason="a quarter of a sample: less rounds no edge that a recording shows",
        special_case_of=("command_memory", "command_plays", "supply_memory"),
        interchangeable=(("tau", "second"),),
    )
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """The resting flow behind both lags, L/s."""
        return jnp.stack([flow + 0.0 * pressure] * 2)

    def inflow(self, values: Values, flow: Array, state: Array, length: Array) -> Pair:
        """Implicit step towards the commanded flow; a lag of 0 s is there at once."""
        first = (values["tau"] * state[0] + length * flow) / (values["tau"] + length)
        after = (values["second"] * state[1] + length * first) / (values["second"] + length)
        return after, jnp.stack([first, after])


class ValveCurve(Mechanism):
    """Saturating or convex curve of the valve, linear at small commands."""

    description = Description(
        name="valve_curve",
        title="curve of the inspiratory valve",
        site="inspiratory valve",
        equation="q = gain u (1 + a x^m)^(-1/m), x = u / 100, a = (1 - loss)^-m - 1",
        parameters=(
            Parameter(
                "loss",
                "1",
                "share of the flow that is missing fully open; negative: flow gained",
                -1.0,
                0.95,
                0.0,
                0.2,
                0.5,
                share=True,
            ),
            Parameter(
                "power",
                "1",
                "m: 1 bends from the start, higher later",
                0.5,
                4.0,
                1.0,
                1.0,
                1.0,
                shape=True,
                grid=(1.0, 3.0),
            ),
        ),
        source="Flow through an orifice whose area is not proportional to the command, or whose "
        "pressure drop falls as flow rises; monotone for every loss and power. Public recordings "
        "of the PVP ask for a saturating curve in all nine lung settings.",
        signature="Error of one sign that grows with the command: during the first samples of "
        "inspiration, at high flow.",
        confusable=("turbulent_resistance", "supply_droop", "nonlinear_compliance"),
        least=0.04,
        least_reason="linearised valves hold their curve to a few percent",
        special_case_of=("valve_shape",),
    )

    rank = 3

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Command of a linear valve with the same flow."""
        # Above zero, where the derivative by the power is finite.
        x = jnp.clip(jnp.abs(u_in) * 0.01, 1e-6, 1.0)
        bend = (1.0 - values["loss"]) ** -values["power"] - 1.0
        return u_in * (1.0 + bend * x ** values["power"]) ** (-1.0 / values["power"]), memory


class ExhalationValveDelay(Mechanism):
    """An expiratory valve that opens late, and takes its time.

    The strength is the mean delay of the opening, of which a share is a first-order lag.
    """

    description = Description(
        name="exhalation_valve_delay",
        title="late opening of the expiratory valve",
        site="expiratory valve",
        equation="opening slow do/dt = u_out(t - opening (1 - slow)) - o",
        parameters=(
            Parameter(
                "opening",
                "s",
                "mean delay of opening",
                0.0,
                0.15,
                0.0,
                0.05,
                0.1,
                scan=tuple(0.01 * k for k in range(16)),
                kinked=True,
            ),
            Parameter(
                "slow",
                "1",
                "share of the opening's delay that is a lag: 0 for a dead time, 1 for a "
                "valve that opens slowly",
                0.0,
                1.0,
                0.0,
                0.0,
                0.0,
                shape=True,
                grid=(0.0, 1.0),
                share=True,
            ),
        ),
        source="Solenoid and diaphragm of the expiratory valve: 0 to 100 ms. A diaphragm on a "
        "vented pilot opens as its pilot empties.",
        signature="Pressure stays up after the command to open, or falls slowly at first, whatever "
        "the lung; inspiration is not affected.",
        confusable=("inertance", "sensor_lag"),
        least=0.008,
        least_reason="a quarter of a sample: less is the clock's, not the valve's",
        special_case_of=("outlet_memory",),
    )
    stateful = True

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """Delay of a command to open, s."""
        return u_out * values["opening"] * (1.0 - values["slow"])

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Open."""
        return 1.0 + 0.0 * (flow + pressure)

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Opening at the end of the step."""
        opened = self.next_state(values, view.state, view.flow, view)
        return network.plus(outlet=view.outlet * (opened - view.opened))

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """How far the valve is open, 0..1; it closes at once."""
        tau = values["opening"] * values["slow"]
        before = jnp.clip(state, 0.0, 1.0)  # where it closes, a stage starts beyond
        after = (tau * before + view.length * view.opened) / (tau + view.length)
        return jnp.minimum(after, view.opened)


class ExhalationValveClosing(Mechanism):
    """An expiratory valve that closes late."""

    description = Description(
        name="exhalation_valve_closing",
        title="late closing of the expiratory valve",
        site="expiratory valve",
        equation="o(t) = u_out(t - closing) while u_out = 0",
        parameters=(
            Parameter(
                "closing",
                "s",
                "dead time of closing",
                0.0,
                0.15,
                0.0,
                0.04,
                0.08,
                scan=tuple(0.01 * k for k in range(16)),
                kinked=True,
            ),
        ),
        source="A diaphragm closes when its pilot has filled, apart from its opening: 0 to 100 ms. "
        "Public recordings of the PVP ask for 58 ms (57 to 59) beside an opening of 70 to 81 ms.",
        signature="Gas escapes and pressure stays low during the first samples of inspiration, "
        "whatever the lung; expiration is not affected.",
        confusable=("valve_delay", "valve_lag", "circuit_compliance"),
        least=0.008,
        least_reason="a quarter of a sample: less is the clock's, not the valve's",
        special_case_of=("outlet_memory",),
    )

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """Delay of a command to close, s."""
        return (1.0 - u_out) * values["closing"]


#: Flow, L/s, that the stroke's time is of.
_FULL_FLOW = 1e-3 * VALVE_GAIN * 100.0


class ValveRate(Mechanism):
    """A valve whose stroke takes its time, however far it is to go."""

    description = Description(
        name="valve_rate",
        title="limited rate of the inspiratory valve",
        site="inspiratory valve",
        equation="|dq/dt| <= 2.28 L/s / stroke",
        parameters=(
            Parameter(
                "stroke",
                "s",
                "time from shut to fully open",
                0.0,
                3.0,
                0.0,
                0.3,
                0.8,
                scan=(0.1, 0.2, 0.4, 0.8, 1.6),
            ),
        ),
        source="Stepper motors and motor-driven valves: 0.1 to 2 s a stroke.",
        signature="Large edges of the command arrive as ramps, small ones at once; unlike a lag, "
        "whose time does not depend on the size of the edge.",
        confusable=("valve_lag", "valve_delay", "circuit_compliance"),
        least=0.05,
        least_reason="less is through with the edges of usual breaths within a sample",
        special_case_of=("command_memory", "supply_memory"),
    )
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """The resting flow, L/s."""
        return flow + 0.0 * pressure

    def inflow(self, values: Values, flow: Array, state: Array, length: Array) -> Pair:
        """The flow as far as the valve gets in the step."""
        reach = length * _FULL_FLOW / jnp.maximum(values["stroke"], 1e-9)
        after = state + jnp.clip(flow - state, -reach, reach)
        return after, after


class ValveStiction(Mechanism):
    """A valve that sticks until the command is far enough away, then jumps to it."""

    description = Description(
        name="valve_stiction",
        title="stiction of the inspiratory valve",
        site="inspiratory valve",
        equation="u_effective = u if |u - u_effective before| > band, else as before",
        parameters=(
            Parameter(
                "band",
                "%",
                "distance of the command at which the valve lets go",
                0.0,
                15.0,
                0.0,
                2.0,
                5.0,
                # A command that no longer lets go changes all that come after it: the likelihood
                # is jagged within tenths of a percent.
                scan=tuple(0.2 * k for k in range(2, 51)),
                kinked=True,
            ),
        ),
        source="Stick-slip of sliding seals, one-parameter model of Stenman, Gustafsson and "
        "Forsman (Int. J. Adapt. Control 17, 2003, 625); control valves in need of repair stick "
        "over 1 to 10 % of the stroke.",
        signature="Flow stands still while the command creeps, then jumps: errors of either sign "
        "that end in a step, in every breath at other samples.",
        confusable=("valve_hysteresis", "command_rounding"),
        least=0.5,
        least_reason="the resolution of drivers",
        special_case_of=("command_plays",),
    )

    rank = 1
    has_memory = True

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Position of the valve, %, twice."""
        band = values["band"]
        deviation = u_in - memory
        # A short slope instead of a step, by which a fit finds the band.
        free = jnp.clip(0.5 + (jnp.abs(deviation) - band) / (_LETS_GO * band + _THIN), 0.0, 1.0)
        position = memory + free * deviation
        return position, position
