"""A plant that is read through a sensor: mechanisms of the library behind its readings.

The plant need not be known inside. Its readings are the pressure at the sensor, linear between two
samples, and the sensor's mechanisms are integrated as :mod:`ventbench.physics.model` does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ventbench.physics.catalogue import library
from ventbench.physics.mechanism import Assembly, assemble
from ventbench.physics.model import GAMMA
from ventbench.task.interfaces import Signals

#: Substeps of a sample: 4 ms at 30 samples a second, a third of the least lag that is named.
_SUBSTEPS = 8


@flax.struct.dataclass
class SensorState:
    """State of a sensor between two samples; every array has shape ``(...)``."""

    pressure: Array  #: at the sensor, cmH2O.
    internal: dict[str, Array]  #: states of its mechanisms by name.


@flax.struct.dataclass
class Sensor:
    """Mechanisms between a pressure and its reading."""

    values: tuple[Any, ...]  #: one array ``()`` or ``(...)`` for each name.
    names: tuple[str, ...] = flax.struct.field(pytree_node=False)  #: paths of the parameters.

    def init(self, reading: Array) -> SensorState:
        """At rest at a reading, cmH2O."""
        assembly, pressure = self._assembly(), reading
        for name, mechanism in reversed(assembly.mechanisms.items()):
            pressure = mechanism.sensor_input(assembly.values[name], pressure, jnp.asarray(0.0))
        internal = {
            name: mechanism.initial_state(assembly.values[name], 0.0 * pressure, pressure)
            for name, mechanism in assembly.mechanisms.items()
            if mechanism.stateful
        }
        return SensorState(pressure, internal)

    def step(self, state: SensorState, pressure: Array, dt: Array) -> tuple[SensorState, Array]:
        """Reading, cmH2O, after a pressure has gone straight to another one in ``dt`` seconds."""
        assembly, h, before = self._assembly(), dt / _SUBSTEPS, state.pressure
        internal, reading = state.internal, pressure
        for k in range(_SUBSTEPS):
            began = guess = internal
            for ahead, share in ((0.0, GAMMA), ((1.0 - GAMMA) / GAMMA, 1.0)):
                reading = before + (pressure - before) * ((k + share) / _SUBSTEPS)
                following = dict(guess)
                for name, mechanism in assembly.mechanisms.items():
                    first = began.get(name, reading)
                    if mechanism.begins == "line" and mechanism.stateful:
                        first = first + ahead * (guess[name] - first)
                    elif mechanism.begins == "stage":
                        first = guess[name]
                    length = GAMMA * h if mechanism.begins == "line" else share * h
                    reading, new = mechanism.reading(
                        assembly.values[name], reading, 0.0 * reading, first, length
                    )
                    if mechanism.stateful:
                        following[name] = new
                guess = following
            internal = guess
        for name, mechanism in assembly.mechanisms.items():
            reading = mechanism.sensor_output(assembly.values[name], reading, jnp.asarray(0.0))
        return SensorState(pressure, internal), reading

    def _assembly(self) -> Assembly:
        return assemble(self.parameters(), library())

    def parameters(self) -> dict[str, Array]:
        """Parameters by path."""
        return dict(zip(self.names, self.values, strict=True))


@jax.jit
def readings(sensor: Sensor, pressure: Array, dt: Array) -> Array:
    """What a sensor shows of the pressures of n breaths, cmH2O, ``(n, T)``.

    Args:
        sensor: parameters ``()``.
        pressure: at the sensor, cmH2O, ``(n, T)``; each breath begins at rest at its first one,
            which the sensor shows.
        dt: time to the next sample, s, ``(n, T)``.
    """

    def step(state: SensorState, now: tuple[Array, Array]) -> tuple[SensorState, Array]:
        return sensor.step(state, *now)

    first = pressure[:, 0]
    _, rest = jax.lax.scan(step, sensor.init(first), (pressure[:, 1:].T, dt[:, :-1].T))
    return jnp.concatenate([first[:, None], rest.T], axis=1)


@flax.struct.dataclass
class Sensed:
    """Any plant, read through a sensor."""

    simulator: Any  #: the plant.
    sensor: Sensor  #: what stands behind its readings.

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[tuple[Any, Any], Signals]:
        """Both at rest; see :class:`~ventbench.task.interfaces.Plant`."""
        sensor = self.sensor.init(jnp.asarray(pressure) * 1.0)
        state, signals = self.simulator.init(sensor.pressure, peep)
        shown = pressure + 0.0 * signals.reading
        return (state, sensor), signals._replace(reading=shown, airway_pressure=signals.scored)

    def step(
        self, state: tuple[Any, Any], u_in: Array, u_out: Array, dt: Array
    ) -> tuple[tuple[Any, Any], Signals]:
        """Hold one command; see :class:`~ventbench.task.interfaces.Plant`."""
        simulator, signals = self.simulator.step(state[0], u_in, u_out, dt)
        sensor, reading = self.sensor.step(state[1], signals.reading, dt)
        sensed = signals._replace(reading=reading, airway_pressure=signals.scored)
        return (simulator, sensor), sensed

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> Sensed:
        """Return the same lung with another resistance, compliance and gain."""
        return Sensed(self.simulator.vary(r_scale, c_scale, gain), self.sensor)

    def parameters(self) -> dict[str, Array] | None:
        """Those of the plant and of its sensor; see :class:`~ventbench.task.interfaces.Plant`."""
        known = self.simulator.parameters()
        return None if known is None else known | self.sensor.parameters()


def sensor(values: Mapping[str, ArrayLike]) -> Sensor:
    """A sensor of parameters by path, ``{"sensor_lag.tau": 0.08}``.

    Its leaves are NumPy's, and take the precision in force where they are used.
    """
    return Sensor(tuple(np.asarray(x, float) for x in values.values()), tuple(values))
