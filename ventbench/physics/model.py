"""A lung on its ventilator with any set of mechanisms: a plant whose parameters can be fitted.

Commands are held from sample to sample, and dead times are exact for held commands (see
``dead_time``). All else is integrated by a two-stage SDIRK method (see ``solver``): second order
and L-stable, so that a circuit without compliance and a gas without inertance, whose equations are
algebraic, need no case of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array
from numpy.typing import ArrayLike

from ventbench.base.errors import InputError
from ventbench.physics import dead_time, solver
from ventbench.physics.catalogue import everything, parameter, paths
from ventbench.physics.mechanism import Assembly, assemble
from ventbench.physics.solver import ContinuousState
from ventbench.task.interfaces import Signals
from ventbench.task.lungs import Lung


@flax.struct.dataclass
class PhysicsState:
    """State between two samples; every array has shape ``(...)``."""

    continuous: ContinuousState  #: see :class:`~ventbench.physics.solver.ContinuousState`.
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
        Without ``peep``, the parameter ``PEEP`` is taken, and without that the pressure.
        """
        assembly = self._assembly()
        pressure = jnp.asarray(pressure) * 1.0
        shape = jnp.broadcast_shapes(pressure.shape, *(jnp.shape(v) for v in self.values))
        shown = jnp.broadcast_to(pressure, shape)
        if peep is None:
            peep = assembly.base["PEEP"] if "PEEP" in self.names else shown
        u_in = assembly.base["rest"] + 0.0 * shown
        memory = {
            name: u_in for name, mechanism in assembly.mechanisms.items() if mechanism.has_memory
        }
        # Inactive mechanisms as well, because the memories get their shapes here.
        flow, memory = solver.commanded(replace(assembly, active={}), u_in, memory)
        rest, ones = solver.at_rest(assembly, shown, flow), jnp.ones_like(flow)
        state = PhysicsState(
            rest, memory, (flow,) * (self.memory + 1), (ones,) * (self.memory + 1),
            (0.03 * ones,) * self.memory, 0.0 * ones, rest.volume, peep * ones,
        )  # fmt: skip
        return state, Signals(shown, rest.pressure, 1000.0 * rest.flow, 0.0 * ones)

    def step(
        self, state: PhysicsState, u_in: Array, u_out: Array, dt: Array,
        divisions: int | Array | None = None,
    ) -> tuple[PhysicsState, Signals]:  # fmt: skip
        """Hold one command; see :class:`~ventbench.task.interfaces.Plant`.

        ``divisions`` are steps of the integrator in a substep; the model's own if not given. The
        volume is above that of the first sample.
        """
        assembly = self._assembly()
        divisions = self.divisions if divisions is None else divisions
        zero = jnp.zeros_like(state.time)
        flow, memory = solver.commanded(assembly, u_in + zero, state.memory)
        commanded = (flow, *state.commanded)
        opened = (u_out + zero, *state.opened)
        time = state.time
        delay = assembly.total(lambda mechanism, own: mechanism.dead_time(own, time))
        outlet_delay = assembly.total(
            lambda mechanism, own: mechanism.outlet_dead_time(own, u_out, time)
        )
        lengths, open_for, commanded_flow = dead_time.windows(
            dt, state.past, (outlet_delay, delay), (opened, commanded), self.substeps,
            self.skip_idle,
        )  # fmt: skip
        held = (commanded_flow, open_for, lengths)

        def advance(k: Array, carry: tuple[Any, Array]) -> tuple[Any, Array]:
            now, time = carry
            # Both are positive: Python's rounding of a quotient would be done for each element.
            place = jax.lax.div(k, jnp.asarray(divisions, k.dtype))
            commanded_flow, opened, h = jax.tree.map(lambda x: x[place], held)
            part = h / divisions
            now = solver.substep(assembly, now, commanded_flow, opened, time, part, state.peep)
            return now, time + part

        # As a loop: unrolled, XLA compiles for minutes and repeats computations.
        count = divisions * len(held[0])
        now, time = jax.lax.fori_loop(0, count, advance, (state.continuous, state.time))
        after = PhysicsState(
            now, memory, commanded[:-1], opened[:-1],
            (dt + zero, *state.past)[:-1], time, state.first, state.peep,
        )  # fmt: skip
        volume = 1000.0 * (now.volume - state.first)
        reading = solver.sensor_output(assembly, now.reading)
        return after, Signals(reading, now.pressure, 1000.0 * now.flow, volume)

    def reading_of(self, pressure: Array) -> Array:
        """What the sensor shows of a pressure that does not change, cmH2O."""
        return solver.sensor_output(self._assembly(), jnp.asarray(pressure))

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> Physics:
        """Return the model with scaled resistance, compliance and gain of the valve."""
        scales = {"R": r_scale, "C": c_scale, "gain": gain}
        unscaled = isinstance(gain, float) and gain == 1.0
        own = self if unscaled else self.having(gain=self.get("gain"))
        varied = [
            value * scales.get(parameter(name).follows or name, 1.0)
            for name, value in zip(own.names, own.values, strict=True)
        ]
        return own.replace(values=tuple(varied))  # type: ignore[attr-defined]

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
    own = {f"{m}.{p}": x for m, given in (mechanisms or {}).items() for p, x in given.items()}
    return Physics((), ()).having(R=lung.R, C=lung.C, **base, **own)
