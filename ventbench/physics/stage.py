"""One implicit step of everything that moves, from the valve's command to the sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
from jax import Array

from ventbench.physics import base
from ventbench.physics.mechanism import Mechanism, Values
from ventbench.physics.network import Network, View

#: Share of a substep after which the first stage of the SDIRK method lies.
GAMMA = 1.0 - 0.5**0.5

_BASE = {item.name: item.neutral for item in base.PARAMETERS}


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


@dataclass(frozen=True)
class Parts:
    """Parameters sorted by owner, and the mechanisms that act, in order of rank."""

    base: Values
    mechanisms: dict[str, Mechanism]
    own: dict[str, Values]

    def total(self, term: Callable[[Mechanism, Values], Array | float]) -> Array | float:
        """Sum over mechanisms."""
        return sum(term(item, self.own[name]) for name, item in self.mechanisms.items())


def parts(named: Mapping[str, Array], library: Mapping[str, Mechanism]) -> Parts:
    """Sort parameters, given by path, and fill in what is not named."""
    # Arrays of numpy, as a file gives them, become what dead times are told by.
    named = {path: jnp.asarray(value) for path, value in named.items()}
    owners = {path.rpartition(".")[0] for path in named}
    acting = sorted((n for n in library if n in owners), key=lambda n: (library[n].rank, n))
    own = {}
    for name in acting:
        items = library[name].description.parameters
        own[name] = {p.name: named.get(f"{name}.{p.name}", jnp.asarray(p.neutral)) for p in items}
    given = {name: named.get(name, jnp.asarray(value)) for name, value in _BASE.items()}
    return Parts(given, {name: library[name] for name in acting}, own)


def commanded(
    parts: Parts, u_in: Array, memory: dict[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Flow that a command asks for once the valve has settled, L/s, and what is remembered."""
    memory = dict(memory)
    for name, item in parts.mechanisms.items():
        u_in, kept = item.command(parts.own[name], u_in, memory.get(name, u_in))
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
    for _ in range(6):
        still = now.replace(volume=volume)  # type: ignore[attr-defined]
        # A long step, in which stresses relax; before the breath, so that no muscle pulls.
        network = _network(parts, still, still, flow, zero, zero - 1e3, zero + 1e6, pressure)
        volume = volume - (network.recoil - goal) / network.elastance
    return now.replace(volume=volume)  # type: ignore[attr-defined]


def substep(
    parts: Parts, now: Stage, wanted: Array, opened: Array, time: Array, h: Array, peep: Array
) -> Stage:
    """Advance by ``h`` seconds: two stages, the second at the end of the substep."""

    def advance(guess: Stage, place: tuple[Array, Array]) -> tuple[Stage, None]:
        ahead, share = place
        start = jax.tree.map(lambda a, b: a + ahead * (b - a), now, guess)
        end = time + share * h
        return _implicit(parts, start, guess, wanted, opened, end, GAMMA * h, peep), None

    places = jnp.asarray([[0.0, GAMMA], [(1.0 - GAMMA) / GAMMA, 1.0]], h.dtype)
    return jax.lax.scan(advance, now, (places[:, 0], places[:, 1]))[0]


def shown(parts: Parts, reading: Array) -> Array:
    """What is recorded of the sensor's output, cmH2O."""
    for name, item in parts.mechanisms.items():
        reading = item.shown(parts.own[name], reading, parts.base["position"])
    return reading


def _implicit(
    parts: Parts,
    start: Stage,
    guess: Stage,
    wanted: Array,
    opened: Array,
    time: Array,
    length: Array,
    peep: Array,
) -> Stage:
    """Backward step of ``length`` seconds that ends at ``time``; ``guess`` is near its end."""
    own, flow = dict(start.own), wanted
    for name, item in parts.mechanisms.items():
        flow, kept = item.inflow(parts.own[name], flow, start.own.get(name, flow), length)
        if item.stateful:
            own[name] = kept
    network = _network(parts, start, guess, flow, opened, time, length, peep)
    pressure, flow = network.solve(start.pressure, start.flow, length)
    reading = pressure
    for name, item in parts.mechanisms.items():
        values = parts.own[name]
        reading, kept = item.reading(values, reading, own.get(name, reading), length)
        if item.stateful:
            view = _view(parts, start, guess, kept, opened, time, length, peep)
            own[name] = item.settle(values, kept, flow, view)
    return Stage(start.volume + flow * length, flow, pressure, reading, own)


def _view(
    parts: Parts, start: Stage, guess: Stage, own: Array, opened: Array, time: Array, length: Array,
    peep: Array,
) -> View:  # fmt: skip
    return View(
        time, start.volume, guess.pressure, guess.flow, own, length, 1e3 / parts.base["C"], peep,
        parts.base["position"], parts.base["R"], 1.0 / parts.base["R_ex"], opened,
    )  # fmt: skip


def _network(
    parts: Parts,
    start: Stage,
    guess: Stage,
    inflow: Array,
    opened: Array,
    time: Array,
    length: Array,
    peep: Array,
) -> Network:
    zero = jnp.zeros_like(start.volume)
    elastance = 1e3 / parts.base["C"]
    network = Network(
        inflow=inflow, circuit=zero, leak=zero, leak_flow=zero,
        outlet=opened / parts.base["R_ex"], behind=peep, resistance=parts.base["R"] + zero,
        quadratic=zero, inertance=zero, recoil=elastance * start.volume, elastance=elastance + zero,
    )  # fmt: skip
    for name, item in parts.mechanisms.items():
        own = start.own.get(name, zero)
        view = _view(parts, start, guess, own, opened, time, length, peep)
        network = item.network(parts.own[name], network, view)
    return network
