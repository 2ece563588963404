"""A simulator plus what another physics would add to it; and plants under stress.

A stressed plant is the scored plant, plus what physics with a stressor does and without does not.
The physics *without* is the reference physics of the scored plant: what the library can say of it.
A plant says it by its ``parameters``, so that the difference is taken where a learned rig works;
for a plant that says nothing they are those of the label.
The physics *with* has the strength of the stressor in addition. Both are one model with the same
parameters, so that all cells of all conditions run in one batch, without a branch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base.arrays import Floats
from ventbench.physics.catalogue import parameter, paths
from ventbench.physics.model import Physics
from ventbench.plants.hybrid import RELIEF, RELIEF_CONDUCTANCE
from ventbench.task import protocol
from ventbench.task.interfaces import Plant, Signals
from ventbench.task.lungs import Lung
from ventbench.task.stressors import Condition, Severity, Stressor, stressor


@flax.struct.dataclass
class Corrected:
    """Any plant, corrected by the difference of two physics.

    The pressure is ``simulator + with_mechanisms - without_mechanisms``. What the simulator knows
    beyond the physics stays; where both physics agree, the plant is the simulator. Plant files
    call the two physics ``wanted`` and ``had``.
    """

    simulator: Any  #: the plant that is corrected.
    with_mechanisms: Any  #: physics of the recordings, with the missing mechanisms.
    without_mechanisms: Any  #: physics of the simulator itself.

    def init(
        self, pressure: Array, peep: Array | None = None
    ) -> tuple[tuple[Any, Any, Any], Signals]:
        """All three plants at rest; see :class:`~ventbench.task.interfaces.Plant`."""
        parts = (self.simulator, self.with_mechanisms, self.without_mechanisms)
        states, signals = zip(*(part.init(pressure, peep) for part in parts), strict=True)
        return states, corrected_signals(*signals)

    def step(
        self, state: tuple[Any, Any, Any], u_in: Array, u_out: Array, dt: Array
    ) -> tuple[tuple[Any, Any, Any], Signals]:
        """Hold one command; see :class:`~ventbench.task.interfaces.Plant`."""
        simulator, base = self.simulator.step(state[0], u_in, u_out, dt)
        more_state, more = self.with_mechanisms.step(state[1], u_in, u_out, dt)
        less_state, less = self.without_mechanisms.step(state[2], u_in, u_out, dt)
        return (simulator, more_state, less_state), corrected_signals(base, more, less)

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> Corrected:
        """Return the same lung with another resistance, compliance and gain."""
        parts = (self.simulator, self.with_mechanisms, self.without_mechanisms)
        return Corrected(*(part.vary(r_scale, c_scale, gain) for part in parts))

    def parameters(self) -> dict[str, Array] | None:
        """Those with the mechanisms; see :class:`~ventbench.task.interfaces.Plant`."""
        return self.with_mechanisms.parameters()


def corrected_signals(simulator: Signals, more: Signals, less: Signals) -> Signals:
    """Signals of a simulator plus the difference of two physics.

    Flow and volume are None where the simulator has none. A simulator that has readings only is
    taken to read the airway.
    """

    def sum_of(base: Any, name: str) -> Any:
        return None if base is None else base + getattr(more, name) - getattr(less, name)

    return Signals(
        sum_of(simulator.reading, "reading"),
        sum_of(simulator.scored, "airway_pressure"),
        sum_of(simulator.flow, "flow"),
        sum_of(simulator.volume, "volume"),
    )


@flax.struct.dataclass
class Stressed:
    """A plant under stress: :class:`~ventbench.plants.corrected.Corrected` that starts from truth.

    Both physics are one model with an axis of two in front, so that they are compiled once.
    """

    simulator: Any  #: the scored plant.
    physics: Physics  #: with the stressor, then without, leaves ``(2,)``.

    def init(self, pressure: Array, peep: Array | None = None) -> tuple[tuple[Any, Any], Signals]:
        """Lung at rest at a true pressure; see :class:`~ventbench.task.interfaces.Plant`."""
        behind = pressure if peep is None else peep
        reading = self.physics.reading_of(jnp.stack([pressure, pressure]))
        state, _ = self.physics.init(reading, behind)
        simulator, unstressed = self.simulator.init(pressure, behind)
        flow = None if unstressed.flow is None else 0.0 * unstressed.flow
        signals = Signals(reading[0] + 0.0 * pressure, pressure, flow, 0.0 * pressure)
        return (simulator, state), signals

    def step(
        self, state: tuple[Any, Any], u_in: Array, u_out: Array, dt: Array
    ) -> tuple[tuple[Any, Any], Signals]:
        """Hold one command; the volume is that of the physics with the stressor."""
        simulator, unstressed = self.simulator.step(state[0], u_in, u_out, dt)
        physics, both = self.physics.step(state[1], u_in, u_out, dt)
        more, less = (jax.tree.map(lambda leaf, k=k: leaf[k], both) for k in (0, 1))
        signals = corrected_signals(unstressed, more, less)._replace(volume=more.volume)
        return (simulator, physics), signals

    def vary(self, r_scale: Array, c_scale: Array, gain: Array | float = 1.0) -> Stressed:
        """Return the same lung with another resistance and compliance."""
        parts = (self.simulator, self.physics)
        return Stressed(*(part.vary(r_scale, c_scale, gain) for part in parts))

    def parameters(self) -> dict[str, Array]:
        """Those with the stressor; see :class:`~ventbench.task.interfaces.Plant`."""
        return {path: value[..., 0] for path, value in self.physics.parameters().items()}


def reference_physics(plant: Plant, lungs: Sequence[Lung]) -> dict[str, Floats]:
    """Parameters of the library's physics that say most of what the plants of L lungs do, by path.

    They are what the plant says, of its batch shape; for a plant that says nothing those of the
    labels, shape ``(L,)``.
    """
    wide: Any = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), plant)
    parameters = wide.parameters()
    if parameters is not None:
        return {path: np.asarray(value) for path, value in parameters.items()}
    return {
        "R": np.array([lung.R for lung in lungs]),
        "C": np.array([lung.C for lung in lungs]),
        "relief_valve.conductance": np.full(len(lungs), RELIEF_CONDUCTANCE),
        "relief_valve.opening": np.full(len(lungs), RELIEF),
    }


def stressed_plants(
    plant: Plant, lungs: Sequence[Lung], conditions: Sequence[Condition]
) -> Stressed:
    """Put every lung under every condition.

    Args:
        plant: scored plants, leaves ``(1, L, n, ...)``: n cells of each lung; or ``(S, L, n, ...)``
            where each condition has its own.
        lungs: labels, length L.
        conditions: S of them.

    Returns:
        A plant for each cell and breath of a run: leaves ``(S * L * n, BREATHS, ...)``, of the
        physics ``(S * L * n, BREATHS, 2)``.
    """
    count = np.shape(jax.tree.leaves(plant)[0])[2]
    cells = (len(conditions), len(lungs), count)
    base = {
        name: np.broadcast_to(value[:, None] if value.ndim == 1 else value, cells)
        for name, value in reference_physics(plant, lungs).items()
    }
    names = _parameters(base, conditions)
    base = {name: base.get(name, np.full(cells, parameter(name).neutral)) for name in names}
    before = {
        name: np.broadcast_to(value, (protocol.BREATHS, *cells)) for name, value in base.items()
    }
    after = {name: value.copy() for name, value in before.items()}
    labels = np.array([[lung.R, lung.C] for lung in lungs])[:, :, None]
    for index, condition in enumerate(conditions):
        shares = condition.shares or (1.0,) * len(condition.stressors)
        for name, share in zip(condition.stressors, shares, strict=True):
            parameters = {path: value[:, index] for path, value in after.items()}
            if share:
                _apply(stressor(name), condition.severity or "mild", share, parameters, labels)

    both: Any = tuple(
        np.stack([x[name].reshape(protocol.BREATHS, -1).T for x in (after, before)], axis=-1)
        for name in names
    )

    def repeated(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        rest = leaf.shape[3:]
        every = np.broadcast_to(leaf[:, :, :, None], (*cells, protocol.BREATHS, *rest))
        return every.reshape(-1, protocol.BREATHS, *rest)

    return Stressed(jax.tree.map(repeated, plant), Physics(both, names))


def _apply(
    line: Stressor, severity: Severity, part: float, parameters: dict[str, Floats], labels: Floats
) -> None:
    """Change parameters ``(BREATHS, L, n)`` of one condition in place, by a share of the strength.

    ``labels`` are the R and C that the labels say, ``(L, 2, 1)``.
    """
    strength, share = line.at(severity), part * np.reshape(line.breaths, (-1, 1, 1))
    if line.rule == "add":
        parameters[line.strength] += share * strength
    else:
        factor = np.array(strength)
        if line.rule == "label":
            factor = strength / labels[:, 0 if line.strength == "R" else 1]
        for name, value in parameters.items():
            if name == line.strength or parameter(name).follows == line.strength:
                value *= factor**share
    for name, value in line.settings(severity).items():
        parameters[name][:] = np.reshape(value, (-1, 1, 1))


def _parameters(base: dict[str, Floats], conditions: Sequence[Condition]) -> tuple[str, ...]:
    """Paths of the base and of what a condition changes, in the order of the catalogue."""
    used = set(base) | {"R", "C"}
    for line in (stressor(name) for condition in conditions for name in condition.stressors):
        used |= {line.strength, *line.settings("mild")}
    owners = {path.rpartition(".")[0] for path in used}
    return tuple(path for path in paths(tuple(sorted(owners - {""}))) if path in used)
