"""The pressure sensor and the clocks: a lag, a bent curve, an offset, and different rates."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from ventbench.physics.mechanism import (
    Description,
    Mechanism,
    Pair,
    Parameter,
    Values,
)


class SensorLag(Mechanism):
    """The reading follows the airway's pressure through one lag or two."""

    description = Description(
        name="sensor_lag",
        title="lag of the pressure sensor",
        site="sensor",
        equation="tau dx/dt = p - x, second dy/dt = x - y",
        parameters=(
            Parameter("tau", "s", "time constant", 0.0, 0.25, 0.0, 0.05, 0.12),
            Parameter(
                "second",
                "s",
                "time constant of a lag behind the first, as of a filter behind a sampling line",
                0.0,
                0.25,
                0.0,
                0.0,
                0.0,
                shape=True,
            ),
        ),
        source="Low-pass filter of sensor, sampling line and electronics: 5 to 120 ms.",
        signature="All edges of pressure are rounded, in inspiration and at the start of "
        "expiration alike, whatever R is.",
        confusable=("valve_lag", "circuit_compliance", "valve_delay"),
        least=0.012,
        least_reason="a third of a sample: less is an offset between two clocks",
        special_case_of=("sensor_memory",),
        interchangeable=(("tau", "second"),),
    )
    stateful = True

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Pressure behind each lag, cmH2O."""
        return jnp.stack([pressure + 0.0 * flow] * 2)

    def reading(
        self, values: Values, pressure: Array, flow: Array, state: Array, length: Array
    ) -> Pair:
        """Implicit step towards the pressure; a lag of 0 s is there at once."""
        first = (values["tau"] * state[0] + length * pressure) / (values["tau"] + length)
        # So written, a second lag of 0 s changes no bit.
        after = first + values["second"] / (values["second"] + length) * (state[1] - first)
        return after, jnp.stack([first, after])


#: Pressure at which the bent curve meets the straight one again, cmH2O.
SPAN = 40.0

#: Distance from either end of the span up to which the parabola is followed, cmH2O.
_BEYOND = 20.0

#: Least slope of the curve, which must rise everywhere; pressures beyond follow the tangent.
_LEAST_SLOPE = 0.2


class SensorCurve(Mechanism):
    """A parabola on top of the true pressure."""

    description = Description(
        name="sensor_curve",
        title="bent characteristic of the pressure sensor",
        site="sensor",
        equation="y = p + 4 bend p / 40 (1 - p / 40)",
        parameters=(
            Parameter(
                "bend",
                "cmH2O",
                "error at 20 cmH2O of a sensor that is right at 0 and at 40 cmH2O",
                -6.0,
                6.0,
                0.0,
                0.9,
                1.4,
            ),
        ),
        source="Terminal-base nonlinearity of piezoresistive sensors: 0.1 to 1 % of full scale if "
        "compensated, several percent if not.",
        signature="An error by pressure alone, in inspiration and expiration alike, whatever flow "
        "and volume are.",
        confusable=("nonlinear_compliance", "supply_pressure"),
        least=0.25,
        least_reason="half a percent of a usual sensor's full scale",
        special_case_of=("sensor_shape",),
    )

    def sensor_output(self, values: Values, pressure: Array, position: Array) -> Array:
        """Bent pressure."""
        steepness = 4.0 * values["bend"] / SPAN
        # The parabola where it rises and pressures are usual, its tangent beyond.
        low, high = _rising(steepness)
        inside = jnp.clip(pressure, low, high)
        slope = 1.0 + steepness * (1.0 - 2.0 * inside / SPAN)
        return inside + steepness * inside * (1.0 - inside / SPAN) + slope * (pressure - inside)

    def sensor_input(self, values: Values, recorded: Array, position: Array) -> Array:
        """True pressure of a reading, by Newton's method, which the tangents make safe."""
        steepness = 4.0 * values["bend"] / SPAN
        low, high = _rising(steepness)
        pressure = recorded
        for _ in range(8):
            inside = jnp.clip(pressure, low, high)
            slope = 1.0 + steepness * (1.0 - 2.0 * inside / SPAN)
            off = self.sensor_output(values, pressure, position) - recorded
            pressure = pressure - off / slope
        return pressure


def _rising(steepness: Array) -> tuple[Array, Array]:
    """Ends of the pressures at which the parabola is steep enough, cmH2O."""
    # Slope 1 + s (1 - 2 p / 40) = least at p = 20 (1 + (1 - least) / s).
    size = jnp.maximum(jnp.abs(steepness), 1e-6)
    reach = 0.5 * SPAN * (1.0 - _LEAST_SLOPE) / size
    middle = 0.5 * SPAN
    low = jnp.where(steepness < 0, jnp.maximum(middle - reach, -_BEYOND), -_BEYOND)
    high = jnp.where(steepness > 0, jnp.minimum(middle + reach, SPAN + _BEYOND), SPAN + _BEYOND)
    return low, high


class ClockOffset(Mechanism):
    """One dead time of all commands: that of a path or clock that all readings share."""

    description = Description(
        name="clock_offset",
        title="delay between commands and pressure",
        site="sensor",
        equation="y(t) = p(t - offset): both commands act late by one time",
        parameters=(
            Parameter(
                "offset",
                "s",
                "common dead time",
                0.0,
                0.15,
                0.0,
                0.03,
                0.06,
                scan=tuple(0.01 * k for k in range(16)),
                kinked=True,
            ),
        ),
        source="Clocks that are not aligned, a buffer of one to three samples before the log, or a "
        "sensor with a dead time.",
        signature="All that happens in pressure comes late by one time, at edges of both valves "
        "alike.",
        confusable=("valve_delay", "exhalation_valve_delay", "sensor_lag"),
        least=0.008,
        least_reason="a quarter of a sample: less is within the time stamps of a log",
    )

    def dead_time(self, values: Values, time: Array) -> Array:
        """The delay, s."""
        return values["offset"]

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """The delay, s; before the breath, nothing leaves, as the lung is at rest."""
        return jnp.where((time < values["offset"]) & (u_out < 0.5), 0.0, values["offset"])


class ClockSkew(Mechanism):
    """A common dead time that grows through each breath."""

    description = Description(
        name="clock_skew",
        title="clocks of commands and pressure that run apart",
        site="sensor",
        equation="y(t) = p(t - skew t), t = time since the start of the breath",
        parameters=(
            Parameter(
                "skew",
                "1",
                "share of the time by which pressure falls behind",
                0.0,
                0.04,
                0.0,
                0.01,
                0.025,
                scan=(0.0, 0.003, 0.006, 0.012, 0.02, 0.03),
                kinked=True,
                share=True,
            ),
        ),
        source="Quartz clocks agree to 0.01 %; those of operating systems, and rates that are "
        "given as rounded numbers, to 0.1 to 4 %.",
        signature="Early edges are on time; others come late in proportion to the time in the "
        "breath.",
        confusable=("clock_offset", "exhalation_valve_delay", "valve_delay"),
        least=0.002,
        least_reason="4 ms at the end of a breath of 2 s",
    )

    def dead_time(self, values: Values, time: Array) -> Array:
        """The delay of a command at a time in the breath, s."""
        return values["skew"] * time

    def outlet_dead_time(self, values: Values, u_out: Array, time: Array) -> Array:
        """The delay of a command at a time in the breath, s."""
        return values["skew"] * time


#: Time, s, of a line that has no inertia, and where a damping counts as critical: both limits are
#: those of the formulas nearby.
_NO_INERTIA, _CRITICAL = 1e-9, 1e-9


class PressureLine(Mechanism):
    """A sampling line that rings: gas that moves as a plug against the sensor's volume."""

    description = Description(
        name="pressure_line",
        title="resonance of the sensor's line",
        site="sensor",
        equation="time^2 d2y/dt2 + 2 damping time dy/dt + y = p",
        parameters=(
            Parameter("time", "s", "period of the ringing / 2 pi", 0.0, 0.06, 0.0, 0.012, 0.03),
            Parameter(
                "damping",
                "1",
                "share of the critical damping",
                0.05,
                1.0,
                0.3,
                0.3,
                0.3,
                shape=True,
                grid=(0.15, 0.3, 0.6),
                uncertain=True,
            ),
        ),
        source="Lines of manometers and catheters are of second order (Gardner, Anesthesiology 54, "
        "1981, 227): 3 to 30 Hz, damping 0.1 to 0.7.",
        signature="Readings overshoot and ring after every edge of pressure, in inspiration and "
        "expiration alike; flow and volume do not.",
        confusable=("sensor_lag", "inertance"),
        least=0.004,
        least_reason="40 Hz: more than a recording of 30 samples a second shows",
        special_case_of=("sensor_memory",),
    )
    stateful = True
    begins = "stage"
    rank = 1

    def initial_state(self, values: Values, flow: Array, pressure: Array) -> Array:
        """Reading, cmH2O, and ``time`` times its rate of change, where the substep began.

        Beside them pressure, cmH2O, in the first stage of the substep, and its time, s, if it was.
        """
        at_rest = pressure + 0.0 * flow
        return jnp.stack([at_rest, 0.0 * at_rest, at_rest, 0.0 * at_rest])

    def reading(
        self, values: Values, pressure: Array, flow: Array, state: Array, length: Array
    ) -> Pair:
        """Exact step where the pressure ramps as in both stages; without inertia, it shows that.

        The reading follows the ramp ``2 damping time`` late, and rings around that. Ringing faster
        than the step needs no smaller one.
        """
        time, damping = values["time"], values["damping"]
        second = state[3] > 0.0
        ramp = jnp.where(second, (pressure - state[2]) / (length - state[3]), 0.0)
        late = 2.0 * damping * time
        angle = length / jnp.maximum(time, _NO_INERTIA)
        speed = jnp.sqrt(jnp.maximum(1.0 - damping**2, _CRITICAL))
        fades = jnp.exp(-damping * angle)
        cosine, sine = fades * jnp.cos(speed * angle), fades * jnp.sin(speed * angle) / speed
        off, rate = state[0] - (pressure - (length + late) * ramp), state[1] - time * ramp
        after = pressure - late * ramp + (cosine + damping * sine) * off + sine * rate
        rate = (cosine - damping * sine) * rate - sine * off + time * ramp
        first = jnp.stack([state[0], state[1], pressure, length + 0.0 * pressure])
        return after, jnp.where(second, jnp.stack([after, rate, pressure, 0.0 * rate]), first)


class TapConstriction(Mechanism):
    """A pressure tap in a constriction, where gas in motion presses less."""

    description = Description(
        name="tap_constriction",
        title="pressure tap in a constriction",
        site="sensor",
        equation="y = p - drop Q^2",
        parameters=(
            Parameter("drop", "cmH2O s2/L2", "reading lost at 1 L/s", -40.0, 40.0, 0.0, 4.0, 12.0),
        ),
        source="Bernoulli: rho v^2 / 2 at a tap of 4 to 12 mm bore is 0.7 to 50 cmH2O at 1 L/s; "
        "negative where the wall tap faces the stream.",
        signature="Readings are low by the square of flow, in inspiration and at the start of "
        "expiration alike, where a resistance errs with opposite signs.",
        confusable=("turbulent_resistance", "valve_curve"),
        least=0.5,
        least_reason="the stream in a bore of 13 mm, which every adapter has",
    )
    rank = -1

    def reading(
        self, values: Values, pressure: Array, flow: Array, state: Array, length: Array
    ) -> Pair:
        """Pressure at the tap."""
        return pressure - values["drop"] * flow**2, state
