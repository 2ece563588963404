"""Stressed plants: the scored plant, plus what physics with a stressor does and without does not.

The physics *without* is the reference physics of the scored plant: what the library can say of it.
For a learned rig (:class:`~ventbench.plants.hybrid.Hybrid`) its parameters are read off the rig, so
that the difference is taken where the rig works; for another plant they are those of the label.
The physics *with* has the strength of the stressor in addition. Both are one model with the same
parameters, so that all cells of all conditions run in one batch, without a branch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.struct
import jax
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench.physics.catalogue import parameter, paths
from ventbench.physics.model import Physics
from ventbench.plants.corrected import corrected_signals
from ventbench.plants.hybrid import ELASTIC_KNOTS, RELIEF, VALVE_KNOTS, Hybrid
from ventbench.task import protocol
from ventbench.task.interfaces import Plant, Signals
from ventbench.task.lungs import Lung
from ventbench.task.stressors import Condition, Severity, Stressor, stressor

Floats = NDArray[np.float64]

#: Conductance of the relief valve of the reference physics, mL/s per cmH2O: the fully open valve
#: of a rig ends within the room that a rig's own relief leaves.
_RELIEF_CONDUCTANCE = 200.0

#: Command at which the basis term ``valve_shape`` holds the valve's gain, %, and those at which it
#: has a coefficient.
_VALVE_AT, _VALVE_SHAPE = 20.0, (1.0, 3.0, 6.0, 12.0, 35.0, 60.0, 100.0)

#: Recoils at which the elastic curve of a rig is compared with that of the library, cmH2O.
_RECOILS = np.linspace(2.0, 40.0, 39)


@flax.struct.dataclass
class Stressed:
    """A plant under stress: :class:`~ventbench.plants.corrected.Corrected` that starts from truth.

    Both physics are one model with an axis of two in front, so that they are compiled once.

    Attributes:
        simulator: the scored plant.
        physics: with the stressor, then without, leaves ``(2,)``.
    """

    simulator: Any
    physics: Physics

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[tuple[Any, Any], Signals]:
        """Lung at rest at a true pressure; see :class:`~ventbench.task.interfaces.Plant`."""
        behind = pressure if peep is None else peep
        shown = self.physics.reading_of(pressure)
        state, _ = self.physics.init(shown, behind)
        simulator, seen = self.simulator.init(pressure, behind)
        flow = None if seen.flow is None else 0.0 * seen.flow
        signals = Signals(shown[0] + 0.0 * pressure, pressure, flow, 0.0 * pressure)
        return (simulator, state), signals

    def step(
        self, state: tuple[Any, Any], u_in: Array, u_out: Array, dt: Array
    ) -> tuple[tuple[Any, Any], Signals]:
        """Hold one command; the volume is that of the physics with the stressor."""
        simulator, seen = self.simulator.step(state[0], u_in, u_out, dt)
        physics, both = self.physics.step(state[1], u_in, u_out, dt)
        more, less = (jax.tree.map(lambda leaf, k=k: leaf[k], both) for k in (0, 1))
        signals = corrected_signals(seen, more, less)._replace(volume=more.volume)
        return (simulator, physics), signals

    def vary(self, r_scale: Array, c_scale: Array) -> Stressed:
        """Return the same lung with another resistance and compliance."""
        return Stressed(self.simulator.vary(r_scale, c_scale), self.physics.vary(r_scale, c_scale))


def reference_physics(plant: Plant, lungs: Sequence[Lung]) -> dict[str, Floats]:
    """Parameters of the library's physics that say most of what a plant does.

    Args:
        plant: leaves ``(L, ...)``, one lung each on the leading axis.
        lungs: labels, length L.

    Returns:
        Parameters by path, shape ``(L, ...)``: for a learned rig and for physics the batch shape of
        the plant; for other plants ``(L,)``.
    """
    if isinstance(plant, Hybrid):
        return _of_hybrid(plant)
    if isinstance(plant, Physics):
        return {path: np.asarray(plant.get(path), float) for path in plant.names}
    return {
        "R": np.array([lung.R for lung in lungs]),
        "C": np.array([lung.C for lung in lungs]),
        "relief_valve.conductance": np.full(len(lungs), _RELIEF_CONDUCTANCE),
        "relief_valve.opening": np.full(len(lungs), RELIEF),
    }


def _of_hybrid(plant: Hybrid) -> dict[str, Floats]:
    """Read the parameters off learned rigs; the valve's curve is exact at the knots of the term."""
    rig: Any = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), plant)
    knots = np.asarray(VALVE_KNOTS)

    def valve(u_in: float) -> Floats:
        return rig.slopes @ np.clip(u_in - knots, 0.0, np.append(np.diff(knots), np.inf))

    gain = valve(_VALVE_AT) / _VALVE_AT
    # Least squares of the recoil's departure from a line by the first term of its series.
    above = np.maximum(_RECOILS[:, None] - np.asarray(ELASTIC_KNOTS), 0.0)
    departure = rig.stiffening @ above.T
    squares = 0.5 * _RECOILS**2
    ones = np.ones(rig.R.shape)
    return {
        "R": rig.R,
        "C": 1e3 / rig.E,
        "gain": 1e3 * gain,
        "R_ex": 1.0 / rig.closing_conductance,
        "rest": rig.rest,
        "offset": rig.offset,
        "turbulent_resistance.quadratic": rig.K2,
        "nonlinear_compliance.stiffening": departure @ squares / (squares @ squares),
        "valve_delay.delay": rig.valve_delay,
        "valve_lag.tau": rig.valve_lag,
        "circuit_compliance.compliance": 1e3 * rig.circuit_compliance,
        "sensor_lag.tau": rig.sensor_lag,
        "exhalation_valve_delay.closing": rig.closing_delay,
        "relief_valve.conductance": _RELIEF_CONDUCTANCE * ones,
        "relief_valve.opening": RELIEF * ones,
        **{f"valve_shape.c{k}": valve(u) / gain - u for k, u in enumerate(_VALVE_SHAPE, 1)},
    }


def stressed_plants(
    plant: Plant, lungs: Sequence[Lung], conditions: Sequence[Condition]
) -> Stressed:
    """Put every lung under every condition.

    Args:
        plant: scored plants, leaves ``(L, n, ...)``: n cells of each lung.
        lungs: labels, length L.
        conditions: S of them.

    Returns:
        A plant for each cell and breath of a run: leaves ``(S * L * n, BREATHS, ...)``, of the
        physics ``(S * L * n, BREATHS, 2)``.
    """
    leaves = jax.tree.leaves(plant)
    cells = tuple(np.shape(leaves[0])[:2])
    base = {
        name: np.broadcast_to(_trailing(value, 2), cells)
        for name, value in reference_physics(plant, lungs).items()
    }
    names = _parameters(base, conditions)
    base = {name: base.get(name, np.full(cells, parameter(name).neutral)) for name in names}
    size = (protocol.BREATHS, len(conditions), *cells)
    before = {name: np.broadcast_to(value, size) for name, value in base.items()}
    after = {name: value.copy() for name, value in before.items()}
    labels = np.array([[lung.R, lung.C] for lung in lungs])[:, :, None]
    for index, condition in enumerate(conditions):
        for name in condition.stressors:
            own = {path: value[:, index] for path, value in after.items()}
            _apply(stressor(name), condition.severity or "mild", own, labels)

    both: Any = tuple(
        np.stack([x[name].reshape(protocol.BREATHS, -1).T for x in (after, before)], axis=-1)
        for name in names
    )

    def repeated(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        every = np.broadcast_to(leaf[:, :, None], (size[1], *size[2:], size[0], *leaf.shape[2:]))
        return every.reshape(-1, size[0], *leaf.shape[2:])

    return Stressed(jax.tree.map(repeated, plant), Physics(both, names))


def _apply(line: Stressor, severity: Severity, own: dict[str, Floats], labels: Floats) -> None:
    """Change parameters of one condition in place.

    Args:
        line: the stressor.
        severity: its severity.
        own: parameters by path, ``(BREATHS, L, n)``.
        labels: R and C that the labels say, ``(L, 2, 1)``.
    """
    strength, share = line.at(severity), np.reshape(line.breaths, (-1, 1, 1))
    if line.rule == "add":
        own[line.strength] += share * strength
    else:
        factor = np.array(strength)
        if line.rule == "label":
            factor = strength / labels[:, 0 if line.strength == "R" else 1]
        for name, value in own.items():
            if name == line.strength or parameter(name).follows == line.strength:
                value *= factor**share
    for name, value in line.settings(severity).items():
        own[name][:] = np.reshape(value, (-1, 1, 1))


def _parameters(base: dict[str, Floats], conditions: Sequence[Condition]) -> tuple[str, ...]:
    """Paths of the base and of what a condition changes, in the order of the catalogue."""
    used = set(base) | {"R", "C"}
    for line in (stressor(name) for condition in conditions for name in condition.stressors):
        used |= {line.strength, *line.settings("mild")}
    owners = {path.rpartition(".")[0] for path in used}
    return tuple(path for path in paths(tuple(sorted(owners - {""}))) if path in used)


def _trailing(value: Floats, axes: int) -> Floats:
    """Give an array of leading axes as many axes as wanted."""
    return value.reshape(*value.shape, *(1,) * (axes - value.ndim))
