"""Simulators of lungs, whatever they were given as: what all commands and reports talk to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import compilation
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.physics import physics
from ventbench.plants import frozen
from ventbench.plants.stacking import (
    VmappedPlant,
    nominal_plants,
    open_loop_breaths,
    stack_heterogeneous,
    take,
)
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.clocks import sampling_intervals
from ventbench.recordings.read import simulated_pressures
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNGS, Lung, lung
from ventbench.task.rollouts import open_loop


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Simulators(ABC):
    """Simulators of lungs; every kind answers to recorded commands.

    One kind has no more than that (:class:`SimulatedPressures`), one answers to any commands
    (:class:`~ventbench.plants.python_simulators.PythonSimulators`), and the others have plants,
    which can be run in a closed loop and corrected (:class:`PlantSimulators`).
    """

    name: str  #: what messages and reports call them.
    about: Mapping[str, Any]  #: JSON values that results keep of them: version, file, hashes.
    #: lungs for which :attr:`stacked` has plants, in its order; empty where there is none.
    lungs: tuple[Lung, ...] = ()
    #: SHA-256 of the file or manifest that they come from; None if there is none.
    sha256: str | None = None
    #: JSON values that a file of plants says of its making, such as the recording that they were
    #: fitted to and its breaths that no fit has seen.
    origin: Mapping[str, Any] = field(default_factory=dict, repr=False)

    #: Why there are no plants, as the rest of a sentence.
    shortage: ClassVar[str] = ""
    #: Whether there are plants, which can be scored and corrected.
    has_plants: ClassVar[bool] = False

    def __repr__(self) -> str:
        """Class, name and lungs."""
        lungs = ", ".join(lung.id for lung in self.lungs) or "lungs by their label"
        return f"<{type(self).__name__} {self.name}: {lungs}>"

    @property
    def is_base_physics(self) -> bool:
        """Whether they are the base model of :mod:`ventbench.physics` at the labels, no more."""
        return False

    @property
    def stacked(self) -> Plant:
        """One plant whose leaves have :attr:`lungs` on their leading axis, ``(L, ...)``.

        Raises:
            InputError: if there is no plant, or those of the lungs cannot be run together.
        """
        raise InputError(f"{self.name} {self.shortage}. It cannot run in a closed loop.")

    @property
    def ensemble(self) -> Plant:
        """Plants of all members, leaves ``(members, L, ...)``; one member if there is no ensemble.

        Raises:
            InputError: as :attr:`stacked`.
        """
        return jax.tree.map(lambda leaf: np.asarray(leaf)[None], self.stacked)

    def plant(self, lung_id: str) -> Plant:
        """Return the plant of one lung.

        Raises:
            InputError: if there is none.
        """
        requested = lung(lung_id).id
        stacked, ids = self.stacked, [entry.id for entry in self.lungs]
        if requested not in ids:
            raise InputError(f"--lung {lung_id}: the simulators {self.name} have {', '.join(ids)}")
        return take(stacked, ids.index(requested))

    def for_breaths(self, breaths: Breaths) -> Plant:
        """Plants of n recorded breaths, by lung and, where it matters, by rig; leaves ``(n, ...)``.

        Raises:
            InputError: if there are no plants, or none for a lung of the recording.
        """
        raise InputError(f"{self.name} {self.shortage}.")

    def plant_of_breath(self, breaths: Breaths, index: int) -> Plant:
        """Return the plant of one recorded breath, without a leading axis; float64 leaves."""
        with compilation.float64():
            stacked = self.for_breaths(breaths.select([index]))
            inner = stacked.plants if isinstance(stacked, VmappedPlant) else stacked
            return take(inner, 0)

    @abstractmethod
    def pressures(
        self, breaths: Breaths, *, progress: Callable[[int], object] = lambda count: None
    ) -> Floats:
        """Open-loop answers to recorded commands, each from the first recorded pressure.

        Args:
            breaths: n breaths of T samples.
            progress: called with numbers of breaths, as they are done.

        Returns:
            cmH2O, shape ``(n, T)``; NaN for a breath whose first pressure is blank.

        Raises:
            InputError: if there is no simulator for a lung, a function fails or answers with
                another shape, or a table lacks a breath.
        """

    def respond(
        self, lung_id: str, u_in: Floats, u_out: Floats, dt: Floats, *, initial_pressure: float
    ) -> Floats:
        """Pressure at each of T samples, cmH2O, in answer to any sequence of commands.

        Args:
            lung_id: id of the lung, such as ``"R20C50"``.
            u_in: inspiratory valve, %, shape ``(T,)``.
            u_out: expiratory valve, 0/1, shape ``(T,)``.
            dt: time from each sample to the next, s, shape ``(T,)``.
            initial_pressure: pressure at the first sample, where the lung is at rest, cmH2O.

        Raises:
            InputError: if there are only simulated pressures, or none for the lung.
        """
        raise InputError(f"{self.name} {self.shortage}. It cannot run in a closed loop.")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SimulatedPressures(Simulators):
    """Pressures of recorded breaths that somebody's simulator gave."""

    #: columns ``(rows,)`` of the simulated breaths.
    table: Mapping[str, np.ndarray]
    file: str  #: what messages call the table.
    shortage = "holds simulated pressures of recorded breaths, not a simulator"

    def pressures(
        self, breaths: Breaths, *, progress: Callable[[int], object] = lambda count: None
    ) -> Floats:
        """See :meth:`Simulators.pressures`."""
        answers = simulated_pressures(dict(self.table), self.file, breaths, sha256=self.sha256)
        answers[~np.isfinite(breaths.pressure[:, 0])] = np.nan
        progress(len(breaths))
        return answers


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PlantSimulators(Simulators):
    """Plants of lungs: a kind says :attr:`stacked` and :meth:`for_breaths`."""

    has_plants = True

    def pressures(
        self, breaths: Breaths, *, progress: Callable[[int], object] = lambda count: None
    ) -> Floats:
        """See :meth:`Simulators.pressures`."""
        try:
            return open_loop_breaths(self.for_breaths, breaths, progress)
        except jax.errors.JAXTypeError as error:
            raise InputError(
                f"{self.name}: JAX cannot trace this plant's init or step "
                f"({str(error).splitlines()[0]}); write them with jax.numpy, or do not register "
                "the class as a pytree: plain NumPy is then run sample by sample"
            ) from error

    def respond(
        self, lung_id: str, u_in: Floats, u_out: Floats, dt: Floats, *, initial_pressure: float
    ) -> Floats:
        """See :meth:`Simulators.respond`."""
        plant = self.plant(lung_id)
        with compilation.float64():
            commands = (jnp.asarray(column, float)[None] for column in (u_in, u_out, dt))
            start = jnp.asarray([float(initial_pressure)])
            return np.asarray(open_loop(plant, start, *commands))[0]


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class LabelledPlants(PlantSimulators):
    """Plants that need no more than a label, and so are there for every lung."""

    make: Callable[[Lung], Plant]  #: makes the plant of a label.
    #: makes that of a recorded breath, which may solve the same equations more quickly.
    make_of_breath: Callable[[Lung], Plant]
    lungs: tuple[Lung, ...] = LUNGS

    @property
    def is_base_physics(self) -> bool:
        """See :attr:`Simulators.is_base_physics`."""
        return self.make is physics

    @cached_property
    def stacked(self) -> Plant:
        """See :attr:`Simulators.stacked`."""
        with compilation.float64():
            return stack_heterogeneous([self.make(entry) for entry in self.lungs])

    def plant(self, lung_id: str) -> Plant:
        """See :meth:`Simulators.plant`."""
        with compilation.float64():
            return jax.tree.map(np.asarray, self.make(lung(lung_id)))

    def for_breaths(self, breaths: Breaths) -> Plant:
        """See :meth:`Simulators.for_breaths`."""
        return nominal_plants(self.make_of_breath, breaths)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PlantsByLung(PlantSimulators):
    """Plants of some lungs."""

    by_lung: Mapping[str, Plant]  #: by lung id.
    #: plants of a lung at several ventilators, each behind its sampling interval, s, by lung id.
    by_clock: Mapping[str, list[tuple[float, Plant]]]

    @cached_property
    def stacked(self) -> Plant:
        """See :attr:`Simulators.stacked`."""
        return stack_heterogeneous(list(self.by_lung.values()))

    def for_breaths(self, breaths: Breaths) -> Plant:
        """See :meth:`Simulators.for_breaths`: of several ventilators that of the nearest clock."""
        ids = breaths.lung_ids.tolist()
        if missing := sorted(set(ids) - set(self.by_lung)):
            raise InputError(
                f"the simulator has no lung {missing[0]} of the recording ({self.name}); it has "
                f"{', '.join(self.by_lung)}"
            )

        def at(label: str, interval: float) -> Plant:
            rigs = self.by_clock.get(label, [(interval, self.by_lung[label])])
            return min(rigs, key=lambda rig: abs(np.log(rig[0] / interval)))[1]

        pairs = zip(ids, sampling_intervals(breaths).tolist(), strict=True)
        return stack_heterogeneous([at(label, interval) for label, interval in pairs])


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class OnePlant(PlantSimulators):
    """One plant for every lung."""

    given: Plant  #: the plant.
    lungs: tuple[Lung, ...] = LUNGS

    def _repeated(self, count: int) -> Plant:
        return jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x))), self.given)

    @property
    def stacked(self) -> Plant:
        """See :attr:`Simulators.stacked`."""
        return self._repeated(len(self.lungs))

    def for_breaths(self, breaths: Breaths) -> Plant:
        """See :meth:`Simulators.for_breaths`."""
        return VmappedPlant(self._repeated(len(breaths)))


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class FrozenSimulators(PlantSimulators):
    """Plants that were trained, which know their breaths: the official ones or another folder's."""

    trained: frozen.Frozen = field(repr=False)

    @property
    def stacked(self) -> Plant:
        """See :attr:`Simulators.stacked`."""
        return self.trained.plants

    @property
    def ensemble(self) -> Plant:
        """See :attr:`Simulators.ensemble`."""
        return self.trained.ensemble

    def for_breaths(self, breaths: Breaths) -> Plant:
        """See :meth:`Simulators.for_breaths`."""
        return self.trained.for_breaths(breaths)
