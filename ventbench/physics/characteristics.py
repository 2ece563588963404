"""Characteristic of a mechanism: the quantity that it acts on, without the rest of the rig.

A valve is shown by the flow that it gives for a command, a leak by its flow at a pressure, a lag by
its response to a step. Which curve it is follows from the methods that the mechanism overrides, so
that a new mechanism has one without more ado. Nothing here is fitted or integrated with the lung.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base.arrays import Floats
from ventbench.base.compilation import float64
from ventbench.physics.catalogue import mechanism
from ventbench.physics.mechanism import BASE_PARAMETERS, Mechanism, Network, Pair, Values, View
from ventbench.physics.nonparametric import FilterBank

#: Points of a static curve and of a response in time.
_STATIC, _STEPS = 241, 160

#: Steps that are tried: of the flow, L/s, and of the pressure, cmH2O.
_FLOW, _LOW, _HIGH = 0.5, 5.0, 20.0

#: Largest pressures, at the airway and across the expiratory valve, cmH2O, flow, L/s, and
#: acceleration, L/s2, of a static curve.
_PRESSURE, _ACROSS, _AIRWAY_FLOW, _ACCELERATION = 40.0, 30.0, 1.0, 20.0

#: A response is shown for this many of its longest times, and within these limits, s.
_TIMES, _SHORTEST, _LONGEST = 5.0, 0.1, 3.0

#: Smaller differences are no effect.
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class Characteristic:
    """A quantity of one part of the rig, as the baseline and with a mechanism."""

    x: Floats  #: what the quantity depends on, ``(k,)``.
    baseline: Floats  #: the quantity without the mechanism, ``(k,)``.
    acting: Floats  #: the quantity with the mechanism, ``(k,)``.
    x_label: str  #: name and unit of ``x``.
    y_label: str  #: name and unit of the quantity.


def characteristic(
    name: str, values: Mapping[str, float], *, largest_command: float = 100.0
) -> Characteristic | None:
    """Characteristic of a mechanism or basis term; None if it changes nothing that is shown here.

    Args:
        name: its name in the catalogue.
        values: its parameters by short name, and base parameters such as ``R``; what is missing is
            neutral.
        largest_command: where the curve of a command ends at most, %.
    """
    effect = mechanism(name)
    parameters = effect.description.parameters
    with float64():
        acting = {p.name: jnp.asarray(float(values.get(p.name, p.neutral))) for p in parameters}
        base = {p.name: float(values.get(p.name, p.neutral)) for p in BASE_PARAMETERS}
        neutral = {p.name: jnp.asarray(float(p.neutral)) for p in parameters}
        times = [float(acting[p.name]) for p in parameters if p.unit == "s"]
        times += effect.taus if isinstance(effect, FilterBank) else ()
        end = float(np.clip(_TIMES * max(times, default=0.0), _SHORTEST, _LONGEST))
        if effect.has("of_breath"):
            return _in_session(effect, acting, base)
        if effect.has("command") or effect.has("driven"):
            return _command(effect, acting, largest_command)
        if effect.has("dead_time"):
            return _late(float(jnp.asarray(effect.dead_time(acting, jnp.asarray(1.0)))), end)
        opens = effect.stateful and effect.description.site == "expiratory valve"
        if opens or effect.has("outlet_dead_time"):
            return _late_outlet(effect, acting, base, end)
        if effect.has("inflow"):
            return _response(
                effect, acting, effect.inflow, end, 0.0, _FLOW, "flow of the valve, L/s"
            )
        if effect.has("reading"):
            if not effect.stateful:
                return _tapped(effect, acting)

            def shows(acting: Values, pressure: Array, state: Array, length: Array) -> Pair:
                if effect.begins == "stage":  # of the two of a substep
                    _, state = effect.reading(acting, pressure, 0.0 * pressure, state, 0.5 * length)
                return effect.reading(acting, pressure, 0.0 * pressure, state, length)

            label = "reading of the sensor, cmH2O"
            return _response(effect, acting, shows, end, _LOW, _HIGH, label)
        if effect.has("sensor_output"):
            return _sensor(effect, acting)
        if effect.has("network"):
            if effect.stateful:
                return _hold(effect, acting, base, end)
            return _network(effect, acting, neutral, base)
    return None


def _floats(values: Array) -> Floats:
    return np.asarray(values, np.float64)


#: Base parameters that may change from breath to breath.
_OF_BREATH = {
    "R": "resistance R, cmH2O/(L/s)",
    "C": "compliance C, mL/cmH2O",
    "gain": "gain of the valve, mL/s per %",
    "offset": "recoil above the first reading, cmH2O",
}


def _in_session(
    effect: Mechanism, values: Values, base: Mapping[str, float]
) -> Characteristic | None:
    """The base parameter that a mechanism changes, over the recording."""
    x = np.linspace(0.0, 1.0, _STATIC)
    before = {name: jnp.full_like(x, value) for name, value in base.items()}
    before["position"] = jnp.asarray(x)
    after = effect.of_breath(values, before)
    for name, label in _OF_BREATH.items():
        baseline, acting = _floats(before[name]), _floats(after[name])
        if np.max(np.abs(acting - baseline)) > _TINY:
            return Characteristic(100 * x, baseline, acting, "share of the recording, %", label)
    return None


def _command(effect: Mechanism, values: Values, largest: float) -> Characteristic:
    """The command that takes effect, as it rises and, if the mechanism remembers, falls again."""

    def step(u_in: Array, memory: Array) -> tuple[Array, Array]:
        return effect.command(values, effect.driven(values, u_in), memory)

    def effective(top: float) -> tuple[Floats, Floats]:
        rising = np.linspace(0.0, top, _STATIC)
        if not effect.has_memory:
            return rising, _floats(step(jnp.asarray(rising), jnp.asarray(rising))[0])
        both = np.concatenate([rising[::2], rising[::-2]])
        memory, after = jnp.asarray(0.0), []
        for command in both:
            now, memory = step(jnp.asarray(command), memory)
            after.append(float(now))
        return both, np.array(after)

    u_in, after = effective(largest)
    # A dead band of 1 % is nothing on an axis up to 100 %.
    off = float(np.max(np.abs(after - u_in)))
    u_in, after = effective(float(np.clip(6.0 * off, min(5.0, largest), largest)))
    return Characteristic(u_in, u_in, after, "command u_in, %", "command that takes effect, %")


def _late(delay: float, end: float) -> Characteristic:
    """Flow after the command of the inspiratory valve steps from 0 to 20 %."""
    x = np.linspace(-0.2 * end, end, 4 * _STATIC)
    command, position = (np.where(x >= begin, 20.0, 0.0) for begin in (0.0, delay))
    return Characteristic(
        x * 1e3, command, position, "time since the command, ms", "valve opening, %"
    )


def _late_outlet(
    effect: Mechanism, values: Values, base: Mapping[str, float], end: float
) -> Characteristic:
    """Position of the expiratory valve after commands to open and to close."""
    x = np.linspace(-0.2 * end, 2.2 * end, 2 * _STATIC)
    opening, closing = (
        float(jnp.asarray(effect.outlet_dead_time(values, jnp.asarray(u_out), jnp.asarray(1.0))))
        for u_out in (1.0, 0.0)
    )
    command = (x >= 0) & (x < end)
    delayed = ((x >= opening) & (x < end + closing)).astype(np.float64)
    zero, length = jnp.asarray(0.0), jnp.asarray(x[1] - x[0])

    def step(state: Array, target: Array) -> tuple[Array, Array]:
        view, network = _view(base, state, length=length, opened=target)
        opened = effect.network(values, network, view).outlet / view.outlet
        return effect.next_state(values, state, zero, view), opened

    shut = 0.0 * effect.initial_state(values, zero, zero)
    delayed = _floats(jax.lax.scan(step, shut, jnp.asarray(delayed))[1])
    labels = ("time since it is told to open, ms", "expiratory valve, 1 open")
    return Characteristic(x * 1e3, command.astype(np.float64), delayed, *labels)


def _response(
    effect: Mechanism,
    values: Values,
    hook: Callable[..., Pair],
    end: float,
    low: float,
    high: float,
    y_label: str,
) -> Characteristic:
    """Response to a step from ``low`` to ``high`` at time zero, with the edge as a vertical."""
    state, after = jnp.asarray(low), []
    if effect.stateful:
        state = effect.initial_state(values, jnp.asarray(0.0), state)
    for _ in range(_STEPS):
        now, state = hook(values, jnp.asarray(high), state, jnp.asarray(end / _STEPS))
        after.append(float(now))
    x = np.concatenate([[-0.1 * end, 0.0, 0.0], end / _STEPS * np.arange(1, _STEPS + 1)])
    step = np.concatenate([[low, low], np.full(_STEPS + 1, high)])
    return _in_time(x, step, np.concatenate([[low, low, low], after]), y_label)


def _in_time(x: Floats, baseline: Floats, acting: Floats, y_label: str) -> Characteristic:
    """A response in ms or, if it is long, in s."""
    if x[-1] > 0.6:
        return Characteristic(x, baseline, acting, "time since the step, s", y_label)
    return Characteristic(x * 1e3, baseline, acting, "time since the step, ms", y_label)


def _tapped(effect: Mechanism, values: Values) -> Characteristic:
    """Reading at one pressure over the flow that passes the tap."""
    flow = jnp.linspace(-_AIRWAY_FLOW, _AIRWAY_FLOW, _STATIC)
    pressure = jnp.full_like(flow, _HIGH)
    after, _ = effect.reading(values, pressure, flow, 0.0 * flow, jnp.asarray(1e-3))
    labels = ("flow into the lung, L/s", f"reading at {_HIGH:.0f} cmH2O")
    return Characteristic(_floats(flow), _floats(pressure), _floats(after), *labels)


def _sensor(effect: Mechanism, values: Values) -> Characteristic:
    """Reading over the recording, or error of the reading over the pressure."""
    if effect.uses_position:
        x = np.linspace(0.0, 1.0, _STATIC)
        true = np.full_like(x, _HIGH)
        after = effect.sensor_output(values, jnp.asarray(true), jnp.asarray(x))
        return Characteristic(
            100 * x,
            true,
            _floats(after),
            "share of the recording, %",
            f"reading at {_HIGH:.0f} cmH2O",
        )
    x = np.linspace(0.0, _PRESSURE, _STATIC)
    after = effect.sensor_output(values, jnp.asarray(x), jnp.asarray(0.0))
    return Characteristic(
        x, np.zeros_like(x), _floats(after) - x, "pressure, cmH2O", "reading less pressure, cmH2O"
    )


def _view(
    base: Mapping[str, float], state: Array | float = 0.0, **changed: Array
) -> tuple[View, Network]:
    """A lung at rest with the expiratory valve shut, and its network; some quantities as given."""
    shape = jnp.broadcast_shapes(*(jnp.shape(value) for value in changed.values()), ())
    zero = jnp.zeros(shape)
    elastance = 1e3 / base["C"]
    view = View(
        zero,
        zero,
        zero,
        zero,
        zero,
        zero + 1e-3,
        zero + elastance,
        zero + base["PEEP"],
        zero,
        zero + base["R"],
        zero + 1.0 / base["R_ex"],
        zero,
    ).replace(state=jnp.asarray(state), **changed)  # type: ignore[attr-defined]
    network = Network(
        inflow=zero + _FLOW,
        circuit=zero,
        leak=zero,
        leak_flow=zero,
        outlet=view.opened * view.outlet,
        behind=view.peep,
        resistance=view.resistance,
        quadratic=zero,
        inertance=zero,
        recoil=view.elastance * view.volume,
        elastance=view.elastance,
    )
    return view, network


def _network(
    effect: Mechanism, values: Values, neutral: Values, base: Mapping[str, float]
) -> Characteristic | None:
    """The first quantity of circuit, airway and lung that a mechanism without a state changes."""

    def both(**changed: Array) -> tuple[Network, Network]:
        view, network = _view(base, **changed)
        return effect.network(neutral, network, view), effect.network(values, network, view)

    def curve(
        x: Floats, baseline: Array, acting: Array, x_label: str, y_label: str
    ) -> Characteristic | None:
        a, b = (np.broadcast_to(_floats(y), x.shape) for y in (baseline, acting))
        if not np.max(np.abs(a - b)) > _TINY:
            return None
        return Characteristic(x, a, b, x_label, y_label)

    pressure = np.linspace(0.0, _PRESSURE, _STATIC)
    a, b = both(pressure=jnp.asarray(pressure))
    p_label = "airway pressure, cmH2O"
    net_neutral, net_acting = (n.inflow - n.leak * pressure - n.leak_flow for n in (a, b))
    if np.max(np.abs(_floats(b.inflow - a.inflow))) > _TINY:
        return curve(pressure, net_neutral, net_acting, p_label, "flow of the valve, L/s")
    leaking = curve(
        pressure,
        1e3 * (_FLOW - net_neutral),
        1e3 * (_FLOW - net_acting),
        p_label,
        "flow that escapes, mL/s",
    )
    if leaking is not None:
        return leaking
    acceleration = np.linspace(0.0, _ACCELERATION, _STATIC)
    flow = np.linspace(-_AIRWAY_FLOW, _AIRWAY_FLOW, _STATIC)
    a, b = both(flow=jnp.asarray(flow))
    before, after = (
        n.recoil + n.resistance * flow + n.quadratic * flow * np.abs(flow) for n in (a, b)
    )
    volume = np.linspace(0.0, 25.0 * base["C"] * 1e-3, _STATIC)
    c, d = both(volume=jnp.asarray(volume))
    time = np.linspace(0.0, 2.0, _STATIC)
    e, f = both(time=jnp.asarray(time))
    across = np.linspace(0.0, _ACROSS, _STATIC)
    g, h = both(pressure=jnp.asarray(base["PEEP"] + across), opened=jnp.ones(_STATIC))
    return (
        curve(flow, before, after, "flow into the lung, L/s", "pressure along the airway, cmH2O")
        or curve(
            acceleration,
            a.inertance[0] * acceleration,
            b.inertance[0] * acceleration,
            "acceleration of the flow, L/s2",
            "pressure that it takes, cmH2O",
        )
        or curve(
            pressure,
            1e3 * a.circuit[0] * pressure,
            1e3 * b.circuit[0] * pressure,
            p_label,
            "gas that the circuit takes up, mL",
        )
        or curve(time, -e.recoil, -f.recoil, "time in the breath, s", "pull of the muscles, cmH2O")
        or curve(1e3 * volume, c.recoil, d.recoil, "volume, mL", "recoil of the lung, cmH2O")
        or curve(
            1e3 * volume,
            c.resistance,
            d.resistance,
            "volume, mL",
            "resistance of the airway, cmH2O/(L/s)",
        )
        or curve(
            across,
            1e3 * g.outlet,
            1e3 * h.outlet,
            "pressure above PEEP, cmH2O",
            "conductance of the open expiratory valve, mL/s per cmH2O",
        )
    )


def _hold(
    effect: Mechanism, values: Values, base: Mapping[str, float], end: float
) -> Characteristic | None:
    """Pressure that a lung takes which is inflated by 10 cmH2O in 0.1 s and then held."""
    length, inflating = end / _STEPS, 0.1
    count = max(1, round(inflating / length))
    flow = np.zeros(_STEPS)
    flow[:count] = 10.0 * base["C"] * 1e-3 / (count * length)
    state, volume = effect.initial_state(values, jnp.asarray(0.0), jnp.asarray(0.0)), 0.0
    linear, acting = [0.0], [0.0]
    for now in flow:
        view, network = _view(
            base,
            state,
            volume=jnp.asarray(volume),
            length=jnp.asarray(length),
            flow=jnp.asarray(now),
        )
        after = effect.network(values, network, view)
        linear.append(float(network.recoil + network.elastance * length * now))
        resistance = after.resistance - network.resistance
        acting.append(float(after.recoil + (after.elastance * length + resistance) * now))
        state = effect.next_state(values, state, jnp.asarray(now), view)
        volume += now * length
    x = np.linspace(0.0, end, _STEPS + 1)
    of = "recoil of the lung" if effect.description.site == "alveolus" else "pressure it takes"
    return _in_time(x, np.array(linear), np.array(acting), f"{of}, cmH2O")
