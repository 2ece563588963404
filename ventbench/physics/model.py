"""A lung on its ventilator with any set of mechanisms: a plant whose parameters can be fitted.

Commands are held from sample to sample, and dead times are exact for held commands (see
``dead_time``). All else, from the valve's flow to the sensor's output, is integrated by the
two-stage SDIRK method of Alexander (SIAM J. Numer. Anal. 14, 1977, 1006): second order and
L-stable, so that a circuit without compliance and a gas without inertance, whose equations are
algebraic, need no case of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from ventbench.base.errors import InputError
from ventbench.physics import dead_time
from ventbench.physics.catalogue import everything, parameter, paths
from ventbench.physics.mechanism import (
    Assembly,
    Mechanism,
    Network,
    Pair,
    Values,
    View,
    assemble,
)
from ventbench.task.interfaces import Signals
from ventbench.task.lungs import Lung

#: Place of the first stage of the SDIRK method, as a share of the substep.
GAMMA = 1.0 - 0.5**0.5


@flax.struct.dataclass
class ContinuousState:
    """Continuous states of a model; every array has shape ``(...)``."""

    volume: Array  #: volume of the lung, L, zero where a linear lung has no recoil.
    flow: Array  #: into the lung, L/s.
    pressure: Array  #: pressure at the airway, cmH2O.
    reading: Array  #: pressure at the sensor's output, cmH2O.
    #: states of mechanisms by name; ``(K, ...)`` for one with several states.
    internal: dict[str, Array]


@flax.struct.dataclass
class PhysicsState:
    """State between two samples; every array has shape ``(...)``."""

    continuous: ContinuousState
    memory: dict[str, Array]  #: memories of mechanisms from sample to sample, by name.
    #: flows that the last ``memory + 1`` commands ask for, the latest first, L/s.
    commanded: tuple[Array, ...]
    #: expiratory valve during the last ``memory + 1`` samples, the latest first, 0/1.
    opened: tuple[Array, ...]
    past: tuple[Array, ...]  #: durations of the last ``memory`` samples, the latest first, s.
    time: Array  #: time since the start of the breath, s.
    first: Array  #: volume of the lung at the start of the breath, L.
    peep: Array  #: pressure behind the expiratory valve, cmH2O.


@flax.struct.dataclass
class Physics:
    """Base model and mechanisms; parameters that are not named stand at their neutral values."""

    values: tuple[Array, ...]  #: one array ``()`` or ``(...)`` for each name.
    #: paths of parameters, such as ``R`` or ``valve_delay.delay``. A mechanism takes part if any of
    #: its parameters is named; at its neutral strength it changes nothing.
    names: tuple[str, ...] = flax.struct.field(pytree_node=False)
    #: number of substeps in a sample.
    substeps: int = flax.struct.field(pytree_node=False, default=dead_time.SUBSTEPS)
    #: number of past samples that a dead time can reach back over.
    memory: int = flax.struct.field(pytree_node=False, default=dead_time.MEMORY)
    #: skip mechanisms whose parameters are neutral in all elements. This is much faster where few
    #: of many are active; derivatives by the parameters of the others are zero.
    skip_idle: bool = flax.struct.field(pytree_node=False, default=False)
    #: steps of the integrator in a substep.
    divisions: int = flax.struct.field(pytree_node=False, default=1)

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[PhysicsState, Signals]:
        """Lung at rest, expiratory valve open; see :class:`~ventbench.task.interfaces.Plant`.

        ``pressure`` is what the sensor shows; :meth:`reading_of` gives that of an airway pressure.
        Without ``peep``, the parameter ``PEEP`` is taken, and without that, or where it is NaN, the
        pressure.
        """
        assembly = self._assembly()
        pressure = jnp.asarray(pressure) * 1.0
        shape = jnp.broadcast_shapes(pressure.shape, *(jnp.shape(v) for v in self.values))
        recorded = jnp.broadcast_to(pressure, shape)
        if peep is None:
            base_peep = assembly.base["PEEP"] if "PEEP" in self.names else jnp.nan
            peep = jnp.where(jnp.isnan(base_peep), recorded, base_peep)
        u_in = assembly.base["rest"] + 0.0 * recorded
        memory = {
            name: u_in for name, mechanism in assembly.mechanisms.items() if mechanism.has_memory
        }
        # Inactive mechanisms as well, because the memories get their shapes here.
        flow, memory = _commanded(replace(assembly, active={}), u_in, memory)
        rest, ones = _at_rest(assembly, recorded, flow), jnp.ones_like(flow)
        state = PhysicsState(
            rest,
            memory,
            (flow,) * (self.memory + 1),
            (ones,) * (self.memory + 1),
            (0.03 * ones,) * self.memory,
            0.0 * ones,
            rest.volume,
            peep * ones,
        )
        return state, Signals(recorded, rest.pressure, 1000.0 * rest.flow, 0.0 * ones)

    def step(
        self,
        state: PhysicsState,
        u_in: Array,
        u_out: Array,
        dt: Array,
        divisions: int | Array | None = None,
    ) -> tuple[PhysicsState, Signals]:
        """Hold one command; see :class:`~ventbench.task.interfaces.Plant`.

        ``divisions`` are steps of the integrator in a substep; the model's own if not given. The
        volume is above that of the first sample.
        """
        assembly = self._assembly()
        divisions = self.divisions if divisions is None else divisions
        zero = jnp.zeros_like(state.time)
        flow, memory = _commanded(assembly, u_in + zero, state.memory)
        commanded = (flow, *state.commanded)
        opened = (u_out + zero, *state.opened)
        time = state.time
        delay = assembly.total(lambda mechanism, values: mechanism.dead_time(values, time))
        outlet_delay = assembly.total(
            lambda mechanism, values: mechanism.outlet_dead_time(values, u_out, time)
        )
        lengths, open_for, commanded_flow = dead_time.windows(
            dt,
            state.past,
            (outlet_delay, delay),
            (opened, commanded),
            self.substeps,
            self.skip_idle,
        )
        held = (commanded_flow, open_for, lengths)

        def advance(k: Array, carry: tuple[Any, Array]) -> tuple[Any, Array]:
            now, time = carry
            # Both are positive: Python's rounding of a quotient would be done for each element.
            place = jax.lax.div(k, jnp.asarray(divisions, k.dtype))
            commanded_flow, opened, h = jax.tree.map(lambda x: x[place], held)
            part = h / divisions
            now = _substep(assembly, now, commanded_flow, opened, time, part, state.peep)
            return now, time + part

        # As a loop: unrolled, XLA compiles for minutes and repeats computations.
        count = divisions * len(held[0])
        now, time = jax.lax.fori_loop(0, count, advance, (state.continuous, state.time))
        after = PhysicsState(
            now,
            memory,
            commanded[:-1],
            opened[:-1],
            (dt + zero, *state.past)[:-1],
            time,
            state.first,
            state.peep,
        )
        volume = 1000.0 * (now.volume - state.first)
        reading = _sensor_output(assembly, now.reading)
        return after, Signals(reading, now.pressure, 1000.0 * now.flow, volume)

    def reading_of(self, pressure: Array) -> Array:
        """What the sensor shows of a pressure that does not change, cmH2O."""
        return _sensor_output(self._assembly(), jnp.asarray(pressure))

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> Physics:
        """Return the model with scaled resistance, compliance and gain of the valve."""
        scales = {"R": r_scale, "C": c_scale, "gain": gain}
        unscaled = isinstance(gain, float) and gain == 1.0
        model = self if unscaled else self.having(gain=self.get("gain"))
        varied = [
            value * scales.get(parameter(name).follows or name, 1.0)
            for name, value in zip(model.names, model.values, strict=True)
        ]
        return model.replace(values=tuple(varied))  # type: ignore[attr-defined]

    def parameters(self) -> dict[str, Array]:
        """Its own by path; see :class:`~ventbench.task.interfaces.Plant`."""
        return dict(zip(self.names, self.values, strict=True))

    def get(self, name: str) -> Array:
        """Value of a parameter; its neutral value if it is not named."""
        if name in self.names:
            return self.values[self.names.index(name)]
        return jnp.asarray(parameter(name).neutral)

    def having(self, **values: Any) -> Physics:
        """Return a copy with other parameters; ``having(**{"valve_delay.delay": 0.04})``.

        Raises:
            InputError: if there is no such parameter.
        """
        named = self.parameters()
        named |= {name: jnp.asarray(value, float) for name, value in values.items()}
        names = tuple(name for name in paths(tuple(everything())) if name in named)
        if unknown := set(named) - set(names):
            raise InputError(f"no parameter {sorted(unknown)} in the physics; see `paths()`")
        return self.replace(  # type: ignore[attr-defined]
            names=names, values=tuple(named[name] for name in names)
        )

    def _assembly(self) -> Assembly:
        return assemble(self.parameters(), everything(), self.skip_idle)


def physics(
    lung: Lung, mechanisms: Mapping[str, Mapping[str, ArrayLike]] | None = None, **base: ArrayLike
) -> Physics:
    """Build a lung on its ventilator.

    Args:
        lung: R, cmH2O/(L/s), and C, mL/cmH2O.
        mechanisms: parameters by mechanism, ``{"valve_delay": {"delay": 0.04}}``.
        base: other base parameters, ``gain=20.0``.

    Raises:
        InputError: if there is no such mechanism or parameter.
    """
    parameters = {
        f"{m}.{p}": x for m, values in (mechanisms or {}).items() for p, x in values.items()
    }
    return Physics((), ()).having(R=lung.R, C=lung.C, **base, **parameters)


def _commanded(
    assembly: Assembly, u_in: Array, memory: dict[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Steady-state flow of the inspiratory valve at a command, L/s, and the new memory."""
    memory = dict(memory)
    for name, mechanism in assembly.mechanisms.items():
        if mechanism.has("driven"):
            u_in = assembly.change(name, lambda m, values, u: m.driven(values, u), u_in)
    for name, mechanism in assembly.mechanisms.items():
        before = (u_in, memory.get(name, u_in))
        u_in, new_memory = assembly.change(name, lambda m, values, x: m.command(values, *x), before)
        if mechanism.has_memory:
            memory[name] = new_memory
    return assembly.base["gain"] * 1e-3 * u_in, memory


def _at_rest(assembly: Assembly, recorded: Array, flow: Array) -> ContinuousState:
    """State of a lung at a recorded pressure, cmH2O, with the valve's resting flow, L/s.

    The lung is at rest, or gas flows into it at ``initial_flow``. Newton's method finds the volume
    at which the recoil, and the pressure along the way, balance the recorded one.
    """
    pressure = recorded
    for name, mechanism in reversed(assembly.mechanisms.items()):
        pressure = mechanism.sensor_input(
            assembly.values[name], pressure, assembly.base["position"]
        )
    zero = jnp.zeros_like(pressure + flow)
    internal = {
        name: mechanism.initial_state(assembly.values[name], flow, pressure) + zero
        for name, mechanism in assembly.mechanisms.items()
        if mechanism.stateful
    }
    initial_flow = 1e-3 * assembly.base["initial_flow"] + zero
    now = ContinuousState(zero, initial_flow, pressure + zero, pressure + zero, internal)
    goal = pressure + assembly.base["offset"]
    volume = goal * 1e-3 * assembly.base["C"] + zero

    def closer(volume: Array, _: None) -> tuple[Array, None]:
        at_volume = now.replace(volume=volume)  # type: ignore[attr-defined]
        # A long step, in which stresses relax; before the breath, so that no muscle pulls.
        view = _view(assembly, at_volume, at_volume, zero, zero - 1e3, zero + 1e6, pressure)
        network = _network(assembly, at_volume, flow, view, lambda name: internal.get(name, zero))
        along = network.resistance + network.quadratic * jnp.abs(initial_flow)
        excess = network.recoil + along * initial_flow - goal
        return volume - excess / network.elastance, None

    # A loop, as unrolled it would be most of what is to be compiled.
    volume, _ = jax.lax.scan(closer, volume, None, length=6)
    now = now.replace(volume=volume)  # type: ignore[attr-defined]
    view = _view(assembly, now, now, zero, zero - 1e3, zero + 1e6, pressure)
    for name, mechanism in assembly.mechanisms.items():
        if mechanism.begins == "substep":  # what it remembers is that it has come to rest here
            internal[name] = mechanism.next_state(assembly.values[name], internal[name], zero, view)
    return now.replace(internal=internal)  # type: ignore[attr-defined]


def _substep(
    assembly: Assembly,
    now: ContinuousState,
    commanded_flow: Array,
    opened: Array,
    time: Array,
    h: Array,
    peep: Array,
) -> ContinuousState:
    """Advance by ``h`` seconds in two stages, the second of which ends the substep."""

    def advance(guess: ContinuousState, place: tuple[Array, Array]) -> tuple[ContinuousState, None]:
        ahead, share = place
        end = time + share * h
        return _implicit(
            assembly, now, guess, ahead, commanded_flow, opened, end, GAMMA * h, peep
        ), None

    places = jnp.asarray([[0.0, GAMMA], [(1.0 - GAMMA) / GAMMA, 1.0]], h.dtype)
    # Where idle mechanisms are skipped, a loop's bookkeeping takes longer than what it repeats.
    # Where all are computed, two copies would take much longer to compile, above all with slopes.
    unroll = bool(assembly.active)
    return jax.lax.scan(advance, now, (places[:, 0], places[:, 1]), unroll=unroll)[0]


def _sensor_output(assembly: Assembly, reading: Array) -> Array:
    """Recorded pressure, cmH2O, given the pressure after the sensor's dynamics."""
    for name, mechanism in assembly.mechanisms.items():
        reading = mechanism.sensor_output(assembly.values[name], reading, assembly.base["position"])
    return reading


def _implicit(
    assembly: Assembly,
    now: ContinuousState,
    guess: ContinuousState,
    ahead: Array,
    commanded_flow: Array,
    opened: Array,
    time: Array,
    length: Array,
    peep: Array,
) -> ContinuousState:
    """Backward Euler step of ``length`` seconds that ends at ``time``.

    It starts at the share ``ahead`` of the way from ``now`` to ``guess``, which is near its end.
    """

    def between(before: Any, after: Any) -> Any:
        return jax.tree.map(lambda a, b: a + ahead * (b - a), before, after)

    def state(name: str) -> Array:  # hooks call it, so that inactive mechanisms compute nothing
        if name not in now.internal:
            return 0.0 * now.volume
        before = now.internal[name]
        begins = assembly.mechanisms[name].begins
        if begins == "line":
            return between(before, guess.internal[name])
        return before if begins == "substep" else guess.internal[name]

    start = between(now.replace(internal={}), guess.replace(internal={}))  # type: ignore[attr-defined]
    internal, flow = dict(guess.internal), commanded_flow
    for name, mechanism in assembly.mechanisms.items():
        if mechanism.has("inflow"):
            before = (flow, internal.get(name, flow))
            flow, new_state = assembly.change(name, _inflow, before, partial(state, name), length)
            internal |= {name: new_state} if mechanism.stateful else {}
    view = _view(assembly, start, guess, opened, time, length, peep)
    network = _network(assembly, start, flow, view, state)
    pressure, flow = network.solve(start.pressure, start.flow, length)
    reading, view = pressure, view.replace(pressure=pressure)  # type: ignore[attr-defined]
    for name, mechanism in assembly.mechanisms.items():
        if mechanism.has("reading") or mechanism.has("next_state"):
            before = (reading, internal.get(name, reading))
            first = None if mechanism.has("inflow") else partial(state, name)
            passed = length if mechanism.begins == "line" else (1.0 + ahead) * length
            reading, new_state = assembly.change(name, _after, before, first, flow, view, passed)
            internal |= {name: new_state} if mechanism.stateful else {}
    return ContinuousState(start.volume + flow * length, flow, pressure, reading, internal)


def _network(
    assembly: Assembly,
    start: ContinuousState,
    inflow: Array,
    view: View,
    state: Callable[[str], Array],
) -> Network:
    zero = jnp.zeros_like(start.volume)
    network = Network(
        inflow=inflow,
        circuit=zero,
        leak=zero,
        leak_flow=zero,
        outlet=view.opened * view.outlet,
        behind=view.peep,
        resistance=view.resistance + zero,
        quadratic=zero,
        inertance=zero,
        recoil=view.elastance * start.volume,
        elastance=view.elastance + zero,
    )
    for name, mechanism in assembly.mechanisms.items():
        if mechanism.has("network"):
            network = assembly.change(name, _joined, network, partial(state, name), view)
    return network


def _view(
    assembly: Assembly,
    start: ContinuousState,
    guess: ContinuousState,
    opened: Array,
    time: Array,
    length: Array,
    peep: Array,
) -> View:
    base = assembly.base
    return View(
        time,
        start.volume,
        guess.pressure,
        guess.flow,
        jnp.zeros_like(start.volume),
        length,
        1e3 / base["C"],
        peep,
        base["position"],
        base["R"],
        1.0 / base["R_ex"],
        opened,
    )


def _inflow(
    mechanism: Mechanism, values: Values, before: Pair, state: Callable[[], Array], length: Array
) -> Pair:
    return mechanism.inflow(values, before[0], state() if mechanism.stateful else before[1], length)


def _joined(
    mechanism: Mechanism, values: Values, network: Network, state: Callable[[], Array], view: View
) -> Network:
    return mechanism.network(values, network, view.replace(state=state()))  # type: ignore[attr-defined]


def _after(
    mechanism: Mechanism,
    values: Values,
    before: Pair,
    state: Callable[[], Array] | None,
    flow: Array,
    view: View,
    passed: Array,
) -> Pair:
    reading, new_state = before
    if mechanism.stateful and state is not None:
        new_state = state()
    reading, new_state = mechanism.reading(values, reading, flow, new_state, passed)
    view = view.replace(state=new_state)  # type: ignore[attr-defined]
    return reading, mechanism.next_state(
        values, new_state, flow, view
    ) if mechanism.stateful else new_state
