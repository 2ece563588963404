"""Time integration: the two-stage SDIRK method, from the valve's flow to the sensor's output.

The method is that of Alexander (SIAM J. Numer. Anal. 14, 1977, 1006).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Assembly, Mechanism, Network, Pair, Values, View

#: Place of the first stage of the SDIRK method, as a share of the substep.
_GAMMA = 1.0 - 0.5**0.5


@flax.struct.dataclass
class ContinuousState:
    """Continuous states of a model; every array has shape ``(...)``."""

    volume: Array  #: volume of the lung, L, zero where a linear lung has no recoil.
    flow: Array  #: into the lung, L/s.
    pressure: Array  #: pressure at the airway, cmH2O.
    reading: Array  #: pressure at the sensor's output, cmH2O.
    #: states of mechanisms by name; ``(K, ...)`` for one with several states.
    internal: dict[str, Array]


def commanded(
    assembly: Assembly, u_in: Array, memory: dict[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Steady-state flow of the inspiratory valve at a command, L/s, and the new memory."""
    memory = dict(memory)
    for name, mechanism in assembly.mechanisms.items():
        if mechanism.has("driven"):
            u_in = assembly.change(name, lambda m, own, u: m.driven(own, u), u_in)
    for name, mechanism in assembly.mechanisms.items():
        before = (u_in, memory.get(name, u_in))
        u_in, new_memory = assembly.change(name, lambda m, own, x: m.command(own, *x), before)
        if mechanism.has_memory:
            memory[name] = new_memory
    return assembly.base["gain"] * 1e-3 * u_in, memory


def at_rest(assembly: Assembly, recorded: Array, flow: Array) -> ContinuousState:
    """State of a lung at rest at a recorded pressure, cmH2O, with the valve's resting flow, L/s.

    Newton's method finds the volume at which the recoil balances the pressure.
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
    now = ContinuousState(zero, zero, pressure + zero, pressure + zero, internal)
    goal = pressure + assembly.base["offset"]
    volume = goal * 1e-3 * assembly.base["C"] + zero

    def closer(volume: Array, _: None) -> tuple[Array, None]:
        at_volume = now.replace(volume=volume)  # type: ignore[attr-defined]
        # A long step, in which stresses relax; before the breath, so that no muscle pulls.
        view = _view(assembly, at_volume, at_volume, zero, zero - 1e3, zero + 1e6, pressure)
        network = _network(assembly, at_volume, flow, view, lambda name: internal.get(name, zero))
        return volume - (network.recoil - goal) / network.elastance, None

    # A loop, as unrolled it would be most of what is to be compiled.
    volume, _ = jax.lax.scan(closer, volume, None, length=6)
    return now.replace(volume=volume)  # type: ignore[attr-defined]


def substep(
    assembly: Assembly, now: ContinuousState, commanded_flow: Array, opened: Array, time: Array,
    h: Array, peep: Array,
) -> ContinuousState:  # fmt: skip
    """Advance by ``h`` seconds in two stages, the second of which ends the substep."""

    def advance(guess: ContinuousState, place: tuple[Array, Array]) -> tuple[ContinuousState, None]:
        ahead, share = place
        end = time + share * h
        return _implicit(
            assembly, now, guess, ahead, commanded_flow, opened, end, _GAMMA * h, peep
        ), None

    places = jnp.asarray([[0.0, _GAMMA], [(1.0 - _GAMMA) / _GAMMA, 1.0]], h.dtype)
    # Where idle mechanisms are skipped, a loop's bookkeeping takes longer than what it repeats.
    # Where all are computed, two copies would take much longer to compile, above all with slopes.
    unroll = bool(assembly.active)
    return jax.lax.scan(advance, now, (places[:, 0], places[:, 1]), unroll=unroll)[0]


def sensor_output(assembly: Assembly, reading: Array) -> Array:
    """Recorded pressure, cmH2O, given the pressure after the sensor's dynamics."""
    for name, mechanism in assembly.mechanisms.items():
        reading = mechanism.sensor_output(assembly.values[name], reading, assembly.base["position"])
    return reading


def _implicit(
    assembly: Assembly, now: ContinuousState, guess: ContinuousState, ahead: Array,
    commanded_flow: Array, opened: Array, time: Array, length: Array, peep: Array,
) -> ContinuousState:  # fmt: skip
    """Backward Euler step of ``length`` seconds that ends at ``time``.

    It starts at the share ``ahead`` of the way from ``now`` to ``guess``, which is near its end.
    """

    def between(before: Any, after: Any) -> Any:
        return jax.tree.map(lambda a, b: a + ahead * (b - a), before, after)

    def state(name: str) -> Array:  # hooks call it, so that inactive mechanisms compute nothing
        return (
            between(now.internal[name], guess.internal[name])
            if name in now.internal
            else 0.0 * now.volume
        )

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
    reading = pressure
    for name, mechanism in assembly.mechanisms.items():
        if mechanism.has("reading") or mechanism.has("next_state"):
            before = (reading, internal.get(name, reading))
            first = None if mechanism.has("inflow") else partial(state, name)
            reading, new_state = assembly.change(name, _after, before, first, flow, view)
            internal |= {name: new_state} if mechanism.stateful else {}
    return ContinuousState(start.volume + flow * length, flow, pressure, reading, internal)


def _network(
    assembly: Assembly, start: ContinuousState, inflow: Array, view: View,
    state: Callable[[str], Array],
) -> Network:  # fmt: skip
    zero = jnp.zeros_like(start.volume)
    network = Network(
        inflow=inflow, circuit=zero, leak=zero, leak_flow=zero, outlet=view.opened * view.outlet,
        behind=view.peep, resistance=view.resistance + zero, quadratic=zero, inertance=zero,
        recoil=view.elastance * start.volume, elastance=view.elastance + zero,
    )  # fmt: skip
    for name, mechanism in assembly.mechanisms.items():
        if mechanism.has("network"):
            network = assembly.change(name, _joined, network, partial(state, name), view)
    return network


def _view(
    assembly: Assembly, start: ContinuousState, guess: ContinuousState, opened: Array, time: Array,
    length: Array, peep: Array,
) -> View:  # fmt: skip
    base = assembly.base
    return View(
        time, start.volume, guess.pressure, guess.flow, jnp.zeros_like(start.volume), length,
        1e3 / base["C"], peep, base["position"], base["R"], 1.0 / base["R_ex"], opened,
    )  # fmt: skip


def _inflow(
    mechanism: Mechanism, own: Values, before: Pair, state: Callable[[], Array], length: Array
) -> Pair:
    return mechanism.inflow(own, before[0], state() if mechanism.stateful else before[1], length)


def _joined(
    mechanism: Mechanism, own: Values, network: Network, state: Callable[[], Array], view: View
) -> Network:
    return mechanism.network(own, network, view.replace(state=state()))  # type: ignore[attr-defined]


def _after(
    mechanism: Mechanism, own: Values, before: Pair, state: Callable[[], Array] | None, flow: Array,
    view: View,
) -> Pair:  # fmt: skip
    reading, new_state = before
    if mechanism.stateful and state is not None:
        new_state = state()
    reading, new_state = mechanism.reading(own, reading, new_state, view.length)
    view = view.replace(state=new_state)  # type: ignore[attr-defined]
    return reading, mechanism.next_state(
        own, new_state, flow, view
    ) if mechanism.stateful else new_state
