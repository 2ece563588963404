"""The valves: curve, filters and plays of the command, memory of the supply, and the outlet."""

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Description, Network, Pair, Values, View
from ventbench.physics.nonparametric import (
    BasisTerm,
    FilterBank,
    Lines,
    coefficients,
    per_state,
)

#: Commands where the curve bends, %; at the fourth it is zero. Closest where valves begin to open.
_VALVE_KNOTS = (0.0, 1.0, 3.0, 6.0, 12.0, 20.0, 35.0, 60.0, 100.0)

#: Knots at which the curve is zero: what is left at the second is the valve's gain.
_VALVE_FIXED = (0.0, 20.0)
_VALVE_FREE = tuple(u for u in _VALVE_KNOTS if u not in _VALVE_FIXED)


class ValveShape(Lines):
    """A change of the effective command, which keeps it within 0..2 u.

    It is zero at 0 and at 20 %, as a common factor of all flows is the valve's gain, or, from
    pressure alone, a common scale of R, 1/C and R_ex. If no command gets near 20 %, that scale is
    not held, and only the prior keeps it.
    """

    description = Description(
        name="valve_shape",
        title="f(u): any curve of the inspiratory valve",
        site="inspiratory valve",
        equation="q = gain (u + f(u)), f straight between knots, f(0) = f(20 %) = 0",
        parameters=coefficients(
            (f"{u:g} %" for u in _VALVE_FREE),
            unit="%",
            meaning="change of the effective command at",
            low=[-u for u in _VALVE_FREE],
            high=_VALVE_FREE,
            spread=[0.5 * u for u in _VALVE_FREE],
        ),
        source="Straight lines between fixed knots; each effective command stays positive.",
        signature="Error that follows the command, whatever flow and pressure are.",
        confusable=("valve_curve", "valve_dead_band", "command_rounding"),
    )
    absorbed = (1,)
    rank = 5
    knots, fixed = _VALVE_KNOTS, _VALVE_FIXED

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Add the curve to the command."""
        return u_in + self.curve(values, u_in), memory


#: Time constants, s.
_COMMAND_TAUS = (0.02, 0.06, 0.2, 0.7)


class CommandMemory(FilterBank):
    """A bank of first-order filters on the flow of the valve.

    A lasting flow is passed as it is: its factor is the gain. A dead time is met in part only.
    """

    description = Description(
        name="command_memory",
        title="memory of u: any linear memory of the valve",
        site="inspiratory valve",
        equation="q = q_asked + sum_k c_k (s_k - q_asked), tau_k ds_k/dt = q_asked - s_k",
        parameters=coefficients(
            (f"{1e3 * tau:g} ms" for tau in _COMMAND_TAUS),
            unit="1",
            meaning="share of the flow that comes late by",
            low=[-6.0, -6.0, -3.0, -3.0],
            high=[6.0, 6.0, 3.0, 3.0],
            spread=[2.0, 2.0, 1.0, 1.0],
        ),
        source="Sum of fixed exponentials; close to any lag, rise or sag that is linear.",
        signature="Error that follows what the command was some time ago.",
        confusable=("valve_lag", "valve_delay", "supply_droop", "valve_hysteresis"),
    )
    rank = 2
    taus = _COMMAND_TAUS

    def inflow(self, values: Values, flow: Array, state: Array, length: Array) -> Pair:
        """Implicit step of all filters."""
        after = self.step(state, flow, length)
        return flow + self.weighed(values, after - flow), after


#: Widths of the plays, %.
_PLAYS_WIDTHS = (1.0, 2.5, 5.0, 10.0)


class CommandPlays(BasisTerm):
    """A sum of play operators (Prandtl and Ishlinskii) on the command.

    While the command rises they take a constant away, which a dead band would too.
    """

    description = Description(
        name="command_plays",
        title="memory of u: any hysteresis of the valve",
        site="inspiratory valve",
        equation="u_effective = u + sum_k c_k (s_k - u), s_k = clip(s_k before, u -+ width_k / 2)",
        parameters=coefficients(
            (f"{width:g} %" for width in _PLAYS_WIDTHS),
            unit="1",
            meaning="share of the valve with a play of",
            low=-2.0,
            high=2.0,
            spread=0.7,
        ),
        source="Sum of plays of fixed widths; holds any hysteresis that knows no time.",
        signature="Error of one sign while the command rises and of the other while it falls.",
        confusable=("valve_hysteresis", "valve_dead_band"),
    )
    rank = 4
    has_memory = True

    def command(self, values: Values, u_in: Array, memory: Array) -> tuple[Array, Array]:
        """Effective command, %, and the positions of the plays, %, ``(K, ...)``."""
        half = 0.5 * per_state(
            _PLAYS_WIDTHS, jnp.broadcast_to(u_in, (len(_PLAYS_WIDTHS), *u_in.shape))
        )
        positions = jnp.minimum(jnp.maximum(memory, u_in - half), u_in + half)
        shift = jnp.sum(self.stacked(values, positions) * (positions - u_in), axis=0)
        return u_in + shift, positions


#: Time constants, s, and the flow whose effect the coefficients are, L/s.
_SUPPLY_TAUS = (0.3, 1.0, 3.0)
_SUPPLY_FLOW = 0.5


class SupplyMemory(FilterBank):
    """A factor of the flow that depends on the flow before; to first order, any such factor."""

    description = Description(
        name="supply_memory",
        title="memory of u: a factor by recent flow",
        site="supply",
        equation="q = q_valve (1 + sum_k c_k s_k / (0.5 L/s)), tau_k ds_k/dt = q_valve - s_k",
        parameters=coefficients(
            (f"{tau:g} s" for tau in _SUPPLY_TAUS),
            unit="1",
            meaning="share of the flow that is gained at a lasting 0.5 L/s, with the time constant",
            low=-0.6,
            high=0.6,
            spread=0.3,
        ),
        source="Second-order term of a Volterra series, with fixed exponentials.",
        signature="Flow is lost late in inspiration and in big breaths; after a pause it is back.",
        confusable=("supply_droop", "valve_curve"),
    )
    rank = 3
    taus = _SUPPLY_TAUS

    def inflow(self, values: Values, flow: Array, state: Array, length: Array) -> Pair:
        """Implicit step of all filters."""
        after = self.step(state, flow, length)
        return flow * (1.0 + self.weighed(values, after) / _SUPPLY_FLOW), after


#: p - PEEP where the factor bends, cmH2O; where it is 1, the conductance is 1 / R_ex.
_OUTLET_KNOTS = (0.0, 2.0, 5.0, 10.0, 20.0)
_OUTLET_FIXED = (5.0,)
_OUTLET_FREE = tuple(d for d in _OUTLET_KNOTS if d not in _OUTLET_FIXED)


class OutletShape(Lines):
    """A factor of the open valve's conductance, by the pressure across it.

    The factor is 1 at 5 cmH2O above PEEP: there R_ex is R_ex.
    """

    description = Description(
        name="outlet_shape",
        title="exhalation path: any conductance of the expiratory valve",
        site="expiratory valve",
        equation="q_out = o (1 + f(p - PEEP)) (p - PEEP) / R_ex, o how far it is open, f straight "
        "between knots, f(5 cmH2O) = 0",
        parameters=coefficients(
            (f"p - PEEP = {d:g} cmH2O" for d in _OUTLET_FREE),
            unit="1",
            meaning="conductance above 1 / R_ex, times R_ex, at",
            low=-0.9,
            high=6.0,
            spread=1.0,
        ),
        source="Straight lines between fixed knots, as of a diaphragm on a spring.",
        signature="Error during expiration only, whatever the inspiration was.",
        confusable=("exhalation_valve_delay", "inertance"),
    )
    absorbed = (0,)
    rank = 1  # a factor of how far the valve is open, however late that is
    knots, fixed = _OUTLET_KNOTS, _OUTLET_FIXED

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Conductance at the last pressure."""
        excess = self.curve(values, view.pressure - view.peep)
        return network.plus(outlet=network.outlet * excess)


#: Time constants of the opening, s.
_OUTLET_TAUS = (0.015, 0.04, 0.12)


class OutletMemory(FilterBank):
    """A bank of first-order filters on the opening of the valve, which closes promptly.

    A conductance below zero is zero, so that an answer that overshoots downwards is a dead time.
    """

    description = Description(
        name="outlet_memory",
        title="exhalation path: any slow opening of the expiratory valve",
        site="expiratory valve",
        equation="q_out = o (p - PEEP) / R_ex, o = max(0, u_out + sum_k c_k (s_k - u_out)), tau_k "
        "ds_k/dt = u_out - s_k",
        parameters=coefficients(
            (f"{1e3 * tau:g} ms" for tau in _OUTLET_TAUS),
            unit="1",
            meaning="share of the opening that comes late by",
            low=-1.0,
            high=12.0,
            spread=2.0,
            scan=(0.0, 4.0, 10.0),
        ),
        source="Sum of fixed exponentials.",
        signature="Error at the start of expiration, whatever the inspiration was.",
        confusable=("exhalation_valve_delay", "inertance"),
    )
    taus = _OUTLET_TAUS

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Open."""
        return self.lasting(1.0 + 0.0 * (flow + pressure))

    def network(self, values: Values, network: Network, view: View) -> Network:
        """Opening at the end of the step."""
        states = self.next_state(values, view.state, view.flow, view)
        opened = jnp.maximum(view.opened + self.weighed(values, states - view.opened), 0.0)
        return network.plus(outlet=view.outlet * (opened - view.opened))

    def next_state(self, values: Values, state: Array, flow: Array, view: View) -> Array:
        """How far filters of the command are open, 0..1; they close at once."""
        return jnp.minimum(self.step(state, view.opened, view.length), view.opened)
