"""A simulated lung as hardware: any ventbench plant, in real or virtual time.

The plant advances from one change of the command to the next, as in scoring; a sample in between
is what the plant shows by then. A loop of 30 ms so reads what a scored run reads.

A lung may have *concealed* physics, which any words determine: one strong effect of the library,
its strength and its lung, added to a simulator.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hardware_eval.device.program import Identity, Sample
from hardware_eval.emulation.cases import (
    LIBRARY,
    Effect,
    draw_case,
    draw_effect,
    draw_grid,
    random_generator,
)
from hardware_eval.wire.messages import Capability
from ventbench.base.errors import InputError
from ventbench.physics.model import PhysicsState, physics
from ventbench.plants.catalog import load_simulators
from ventbench.plants.corrected import Corrected
from ventbench.task import protocol
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung

#: A command that does not change is taken into the plant's state after this time, s; above the
#: control step, so that a loop decides when, and within the dead times that plants remember.
LONGEST_HOLD = 0.040

#: Shorter holds than this, s, are replaced by the command that follows.
SHORTEST_HOLD = 1e-4

#: What a disturbed tube does: a leak as if the expiratory valve stood open by so much, and a factor
#: of the airway's resistance.
TUBES = {"": (0.0, 1.0), "leak": (0.05, 1.0), "pinch": (0.0, 3.0)}

#: Never concealed: a test lung has no patient, the drift of a sensor over a recording needs to know
#: how long that will be, and the other two hardly matter to a controller.
_LEFT_OUT = ("patient_effort", "sensor_drift", "command_rounding", "inertance")

#: Cases from which the words choose: each mechanism of the library about four times.
_CASES = 68


@dataclass(frozen=True)
class Sensor:
    """What a pressure sensor makes of a pressure, cmH2O."""

    noise: float = 0.0  #: standard deviation.
    quantum: float = 0.0  #: step of the converter; 0 for none.
    highest: float = math.inf  #: end of the range.


#: A sensor without errors, and one with the noise and the converter of PVP's.
PERFECT, PVP_SENSOR = Sensor(), Sensor(noise=0.1, quantum=0.0703)


class SimulatedHal:
    """A plant as a ventilator; compiles the plant once, before any time passes."""

    def __init__(
        self,
        plant: Plant,
        *,
        name: str = "simulated lung",
        sensor: Sensor = PERFECT,
        seed: int = 0,
    ) -> None:
        """Put a lung at rest at PEEP on the ventilator.

        Args:
            plant: the lung on its ventilator, without a batch shape.
            name: what the device is called.
            sensor: of the pressure.
            seed: of its noise.
        """
        self._sensor = sensor
        leaves = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(plant))
        calibration = hashlib.sha256(type(plant).__name__.encode() + leaves).digest()
        start = jnp.asarray(protocol.PEEP, jnp.float32)
        plant = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), plant)
        rest, signals = plant.init(start, start)
        vector, unravel = ravel_pytree(rest)
        flow = Capability.NONE if signals.flow is None else Capability.FLOW
        noisy = sensor.noise > 0.0 and sensor.noise >= 0.5 * sensor.quantum
        self.identity = Identity(
            name,
            calibration[:8],
            calibration,
            Capability.SIMULATED | flow,
            highest=sensor.highest,
            noisy=noisy,
        )

        def advance(vector: jax.Array, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
            u_in, u_out, dt, r_scale, restart = inputs
            state = unravel(vector)
            state = breath_begun(state, restart)
            own = plant.vary(r_scale, jnp.ones_like(r_scale))
            after, seen = own.step(state, u_in, u_out, dt)
            flow = jnp.full_like(seen.reading, jnp.nan) if seen.flow is None else seen.flow
            return ravel_pytree(after)[0], jnp.stack([seen.reading, flow])

        inputs = np.array([0.0, 1.0, LONGEST_HOLD, 1.0, 0.0], np.float32)
        self._advance = jax.jit(advance).lower(vector, inputs).compile()
        jax.block_until_ready(self._advance(vector, inputs))
        self._state = vector
        self._random = np.random.default_rng(seed)
        self._since: float | None = None
        self._command, self._restart, self._tube = (0.0, 1), 0.0, TUBES[""]

    def disturb(self, tube: str) -> None:
        """Disturb the tube as one of :data:`TUBES` says; nothing mends it."""
        if tube not in TUBES:
            raise InputError(f"a tube has no {tube!r}; choose of {', '.join(filter(None, TUBES))}")
        self._tube = TUBES[tube]

    def shown(self, now: float) -> tuple[float, float]:
        """Pressure, cmH2O, and flow, mL/s, by now, as a perfect sensor tells them."""
        pressure, flow = np.asarray(self._by(now)[1])
        return float(pressure), float(flow)

    def forced(self, now: float) -> tuple[float, float, float]:
        """What acts on the plant: u_in, %, the expiratory valve's opening, a factor of R."""
        (u_in, u_out), (leak, r_scale) = self._command, self._tube
        return u_in, max(float(u_out), leak), r_scale

    def sample(self, now: float) -> Sample:
        """Pressure and flow by now; see :class:`~hardware_eval.device.program.Hal`."""
        (pressure, flow), sensor = self.shown(now), self._sensor
        if sensor.noise:
            pressure += sensor.noise * float(self._random.standard_normal())
        if sensor.quantum:
            pressure = round(pressure / sensor.quantum) * sensor.quantum
        pressure = min(pressure, sensor.highest)
        return Sample(now, pressure, flow, saturated=pressure >= sensor.highest)

    def actuate(self, now: float, u_in: float, u_out: int) -> None:
        """Hold a command from now on; see :class:`~hardware_eval.device.program.Hal`."""
        if self._since is None:
            self._since = now
        changed = (u_in, u_out) != self._command
        held = now - self._since
        if not (changed or held >= LONGEST_HOLD):
            return
        if held >= SHORTEST_HOLD:
            self._state, _ = self._by(now)
            self._since, self._restart = now, 0.0
        if self._command[1] == 1 and u_out == 0:
            self._restart = 1.0
        self._command = (u_in, u_out)

    def _by(self, now: float) -> tuple[jax.Array, jax.Array]:
        """State and readings at ``now`` if the present command is held until then."""
        u_in, share, r_scale = self.forced(now)
        held = max(now - (now if self._since is None else self._since), SHORTEST_HOLD)
        # A gap of seconds, as after a suspended machine, goes in steps that the plant can take.
        while True:
            step = LONGEST_HOLD if held > 2.0 * LONGEST_HOLD else held
            inputs = np.array([u_in, share, step, r_scale, self._restart], np.float32)
            state, readings = self._advance(self._state, inputs)
            if step == held:
                return state, readings
            self._state, self._since = state, (self._since or now) + LONGEST_HOLD
            self._restart, held = 0.0, held - LONGEST_HOLD


def breath_begun(state: Any, restart: jax.Array) -> Any:
    """Restart the time in the breath where ``restart`` is 1: some mechanisms act by it."""

    def restarted(part: Any) -> Any:
        if not isinstance(part, PhysicsState):
            return part
        return part.replace(time=part.time * (1.0 - restart))  # type: ignore[attr-defined]

    return jax.tree.map(restarted, state, is_leaf=lambda part: isinstance(part, PhysicsState))


def simulated_lung(lung_id: str, simulator: Any = "frozen", **settings: Any) -> SimulatedHal:
    """Put a lung of what :func:`ventbench.load_simulators` takes on a simulated ventilator.

    Settings are further arguments of :class:`SimulatedHal`.

    Raises:
        InputError: if there is no such simulator or lung.
    """
    plant = load_simulators(simulator).plant(lung_id)
    return SimulatedHal(plant, **{"name": f"emulated {lung_id}", **settings})


@dataclass(frozen=True, eq=False)
class ConcealedLung:
    """A lung with physics that its label does not tell."""

    lung: Lung  #: its label.
    plant: Plant  #: simulator with the concealed physics.
    effect: Effect  #: the concealed physics.


def conceal(words: str, simulator: Any = "frozen") -> ConcealedLung:
    """Make the lung that any words determine: the same words make the same lung.

    The physics is added to a simulator: whatever :func:`ventbench.load_simulators` takes.

    Raises:
        InputError: if there are no words.
    """
    if not words.strip():
        raise InputError("--conceal: give some words; they determine the lung")
    effect, label = _draw(words)
    without, named = physics(label), {effect.name: effect.parameters}
    plant = Corrected(load_simulators(simulator).plant(label.id), physics(label, named), without)
    return ConcealedLung(label, plant, effect)


def _draw(words: str) -> tuple[Effect, Lung]:
    """One strong effect, and its lung."""
    rng = random_generator(words, "emulator")
    drawn = [
        draw_case(lung, (draw_effect(name, strength, rng, form),), rng)
        for name, strength, lung, form in draw_grid(LIBRARY, _CASES, rng, other=False)
    ]
    strong = [
        case
        for case in (drawn[i] for i in rng.permutation(_CASES))
        if case.effects[0].strength == "strong" and case.effects[0].name not in _LEFT_OUT
    ]
    case = strong[int(rng.integers(len(strong)))]
    return case.effects[0], Lung(case.lung_R, case.lung_C)
