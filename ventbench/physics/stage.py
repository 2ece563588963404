"""One implicit step of everything that moves, from the valve's command to the sensor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import Mechanism, Values
from ventbench.physics.network import Network, View
from ventbench.physics.parts import Parts

#: Share of a substep after which the first stage of the SDIRK method lies.
GAMMA = 1.0 - 0.5**0.5

Pair = tuple[Array, Array]


@flax.struct.dataclass
class Stage:
    """What moves; every array has shape ``(...)``.

    Attributes:
        volume: of the lung, L, zero where a linear lung has no recoil.
        flow: into the lung, L/s.
        pressure: at the airway, cmH2O.
        reading: pressure at the sensor's output, cmH2O.
        own: states of mechanisms, by name; of one that keeps several, ``(K, ...)``.
    """

    volume: Array
    flow: Array
    pressure: Array
    reading: Array
    own: dict[str, Array]


def commanded(
    parts: Parts, u_in: Array, memory: dict[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Flow that a command asks for once the valve has settled, L/s, and what is remembered."""
    memory = dict(memory)
    for name, item in parts.mechanisms.items():
        u_in, kept = parts.change(name, _command, (u_in, memory.get(name, u_in)))
        if item.remembers:
            memory[name] = kept
    return parts.base["gain"] * 1e-3 * u_in, memory


def at_rest(parts: Parts, shown: Array, flow: Array) -> Stage:
    """Lung at rest at a recorded pressure, cmH2O, with the resting flow of the valve, L/s.

    Recoil is found by Newton's method on the sum of what mechanisms make of it.
    """
    pressure = shown
    for name, item in reversed(parts.mechanisms.items()):
        pressure = item.meant(parts.own[name], pressure, parts.base["position"])
    zero = jnp.zeros_like(pressure + flow)
    own = {
        name: item.rest(parts.own[name], flow, pressure) + zero
        for name, item in parts.mechanisms.items()
        if item.stateful
    }
    now = Stage(zero, zero, pressure + zero, pressure + zero, own)
    goal = pressure + parts.base["offset"]
    volume = goal * 1e-3 * parts.base["C"] + zero

    def closer(volume: Array, _: None) -> tuple[Array, None]:
        still = now.replace(volume=volume)  # type: ignore[attr-defined]
        # A long step, in which stresses relax; before the breath, so that no muscle pulls.
        view = _view(parts, still, still, zero, zero - 1e3, zero + 1e6, pressure)
        network = _network(parts, still, flow, view, lambda name: own.get(name, zero))
        return volume - (network.recoil - goal) / network.elastance, None

    # A loop, as unrolled it would be most of what is to be compiled.
    volume, _ = jax.lax.scan(closer, volume, None, length=6)
    return now.replace(volume=volume)  # type: ignore[attr-defined]


def substep(
    parts: Parts, now: Stage, wanted: Array, opened: Array, time: Array, h: Array, peep: Array
) -> Stage:
    """Advance by ``h`` seconds: two stages, the second at the end of the substep."""

    def advance(guess: Stage, place: tuple[Array, Array]) -> tuple[Stage, None]:
        ahead, share = place
        end = time + share * h
        return _implicit(parts, now, guess, ahead, wanted, opened, end, GAMMA * h, peep), None

    places = jnp.asarray([[0.0, GAMMA], [(1.0 - GAMMA) / GAMMA, 1.0]], h.dtype)
    return jax.lax.scan(advance, now, (places[:, 0], places[:, 1]))[0]


def shown(parts: Parts, reading: Array) -> Array:
    """What is recorded of the sensor's output, cmH2O."""
    for name, item in parts.mechanisms.items():
        reading = item.shown(parts.own[name], reading, parts.base["position"])
    return reading


def _implicit(
    parts: Parts,
    now: Stage,
    guess: Stage,
    ahead: Array,
    wanted: Array,
    opened: Array,
    time: Array,
    length: Array,
    peep: Array,
) -> Stage:
    """Backward step of ``length`` seconds that ends at ``time``.

    It starts ``ahead`` of the way from ``now`` to ``guess``, which is near its end.
    """

    def between(before: Any, after: Any) -> Any:
        return jax.tree.map(lambda a, b: a + ahead * (b - a), before, after)

    def state(name: str) -> Array:  # called by hooks alone: nothing is computed for idle ones
        return between(now.own[name], guess.own[name]) if name in now.own else 0.0 * now.volume

    start = between(now.replace(own={}), guess.replace(own={}))  # type: ignore[attr-defined]
    own, flow = dict(guess.own), wanted
    for name, item in parts.mechanisms.items():
        if _has(item, "inflow"):
            before = (flow, own.get(name, flow))
            flow, kept = parts.change(name, _inflow, before, partial(state, name), length)
            own |= {name: kept} if item.stateful else {}
    view = _view(parts, start, guess, opened, time, length, peep)
    network = _network(parts, start, flow, view, state)
    pressure, flow = network.solve(start.pressure, start.flow, length)
    reading = pressure
    for name, item in parts.mechanisms.items():
        if _has(item, "reading") or _has(item, "settle"):
            before = (reading, own.get(name, reading))
            first = None if _has(item, "inflow") else partial(state, name)
            reading, kept = parts.change(name, _after, before, first, flow, view)
            own |= {name: kept} if item.stateful else {}
    return Stage(start.volume + flow * length, flow, pressure, reading, own)


def _network(
    parts: Parts, start: Stage, inflow: Array, view: View, state: Callable[[str], Array]
) -> Network:
    zero = jnp.zeros_like(start.volume)
    network = Network(
        inflow=inflow, circuit=zero, leak=zero, leak_flow=zero, outlet=view.opened * view.outlet,
        behind=view.peep, resistance=view.resistance + zero, quadratic=zero, inertance=zero,
        recoil=view.elastance * start.volume, elastance=view.elastance + zero,
    )  # fmt: skip
    for name, item in parts.mechanisms.items():
        if _has(item, "network"):
            network = parts.change(name, _joined, network, partial(state, name), view)
    return network


def _view(
    parts: Parts, start: Stage, guess: Stage, opened: Array, time: Array, length: Array, peep: Array
) -> View:
    base = parts.base
    return View(
        time, start.volume, guess.pressure, guess.flow, jnp.zeros_like(start.volume), length,
        1e3 / base["C"], peep, base["position"], base["R"], 1.0 / base["R_ex"], opened,
    )  # fmt: skip


def _command(item: Mechanism, own: Values, before: Pair) -> Pair:
    return item.command(own, *before)


def _inflow(
    item: Mechanism, own: Values, before: Pair, state: Callable[[], Array], length: Array
) -> Pair:
    return item.inflow(own, before[0], state() if item.stateful else before[1], length)


def _joined(
    item: Mechanism, own: Values, network: Network, state: Callable[[], Array], view: View
) -> Network:
    return item.network(own, network, view.replace(state=state()))  # type: ignore[attr-defined]


def _after(
    item: Mechanism, own: Values, before: Pair, state: Callable[[], Array] | None, flow: Array,
    view: View,
) -> Pair:  # fmt: skip
    reading, kept = before
    if item.stateful and state is not None:
        kept = state()
    reading, kept = item.reading(own, reading, kept, view.length)
    view = view.replace(state=kept)  # type: ignore[attr-defined]
    return reading, item.settle(own, kept, flow, view) if item.stateful else kept


def _has(item: Mechanism, hook: str) -> bool:
    return getattr(type(item), hook) is not getattr(Mechanism, hook)
