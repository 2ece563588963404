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
from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.plants import frozen
from ventbench.plants.stacking import PlantsFor, VmappedPlant, open_loop_breaths, take
from ventbench.recordings.breaths import Breaths
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung, lung
from ventbench.task.rollouts import open_loop


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Simulators(ABC):
    """Simulators of lungs; every kind answers to recorded commands.

    One kind has no more than that (:class:`SimulatedPressures`), one answers to any commands
    (:class:`~ventbench.plants.python_simulators.PythonSimulators`), and one has plants, which can
    be run in a closed loop and corrected (:class:`PlantSimulators`).
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
    #: Whether they are the base model of :mod:`ventbench.physics` at the labels, no more.
    is_base_physics: bool = field(default=False, repr=False)
    #: The official set if they are it, else None.
    official: frozen.Frozen | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        """Class, name and lungs."""
        lungs = ", ".join(lung.id for lung in self.lungs) or "lungs by their label"
        return f"<{type(self).__name__} {self.name}: {lungs}>"

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

    def cross_fitted(self, breaths: Breaths) -> Plant:
        """Plants that have not been trained on the breaths where there are such.

        The same as :meth:`for_breaths` for simulators that are not learned.
        """
        return self.for_breaths(breaths)

    def plant_of_breath(self, breaths: Breaths, index: int) -> Plant:
        """Return the plant of one recorded breath, without a leading axis; float64 leaves."""
        with compilation.float64():
            stacked = self.for_breaths(breaths.select([index]))
            inner = stacked.plants if isinstance(stacked, VmappedPlant) else stacked
            return take(inner, 0)

    def held_out(self, breaths: Breaths) -> Bools:
        """Whether :meth:`cross_fitted` gives a plant that has not seen the breath, ``(n,)``."""
        return np.ones(len(breaths), bool)

    def unseen(self, breaths: Breaths) -> Bools:
        """Whether :meth:`for_breaths` gives a plant that has not seen the breath, ``(n,)``."""
        return np.ones(len(breaths), bool)

    def perhaps_copies(self, breaths: Breaths) -> Bools:
        """Whether the breath is perhaps one of the training, which blank pressures hide, (n,)."""
        return np.zeros(len(breaths), bool)

    @abstractmethod
    def pressures(
        self,
        breaths: Breaths,
        *,
        cross_fitted: bool = False,
        progress: Callable[[int], object] | None = None,
    ) -> Floats:
        """Open-loop answers to recorded commands, each from the first recorded pressure.

        Args:
            breaths: n breaths of T samples.
            cross_fitted: True for the answers of the plants of :meth:`cross_fitted`.
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

    answers: Callable[[Breaths], Floats] = field(repr=False)  #: of n breaths, cmH2O, ``(n, T)``.
    shortage = "holds simulated pressures of recorded breaths, not a simulator"

    def pressures(
        self,
        breaths: Breaths,
        *,
        cross_fitted: bool = False,
        progress: Callable[[int], object] | None = None,
    ) -> Floats:
        """See :meth:`Simulators.pressures`."""
        answers = self.answers(breaths)
        answers[~np.isfinite(breaths.pressure[:, 0])] = np.nan
        if progress is not None:
            progress(len(breaths))
        return answers


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PlantSimulators(Simulators):
    """Plants of lungs."""

    stack: Callable[[], Plant] = field(repr=False)  #: makes :attr:`stacked`.
    of_breaths: PlantsFor = field(repr=False)  #: does :meth:`for_breaths`.
    #: makes the plant of any label, of which :attr:`lungs` are some; None if there are no others.
    at_label: Callable[[Lung], Plant] | None = field(default=None, repr=False)
    has_plants = True

    @cached_property
    def stacked(self) -> Plant:
        """See :attr:`Simulators.stacked`."""
        return self.stack()

    def plant(self, lung_id: str) -> Plant:
        """See :meth:`Simulators.plant`."""
        if self.at_label is None:
            return super().plant(lung_id)
        with compilation.float64():
            return jax.tree.map(np.asarray, self.at_label(lung(lung_id)))

    def for_breaths(self, breaths: Breaths) -> Plant:
        """See :meth:`Simulators.for_breaths`."""
        return self.of_breaths(breaths)

    def pressures(
        self,
        breaths: Breaths,
        *,
        cross_fitted: bool = False,
        progress: Callable[[int], object] | None = None,
    ) -> Floats:
        """See :meth:`Simulators.pressures`."""
        plants_for = self.cross_fitted if cross_fitted else self.for_breaths
        try:
            return open_loop_breaths(plants_for, breaths, progress)
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
class FrozenSimulators(PlantSimulators):
    """Plants that were trained, which know their breaths: the official ones or another folder's."""

    trained: frozen.Frozen = field(repr=False)

    @property
    def ensemble(self) -> Plant:
        """See :attr:`Simulators.ensemble`."""
        return self.trained.ensemble

    def cross_fitted(self, breaths: Breaths) -> Plant:
        """See :meth:`Simulators.cross_fitted`."""
        return self.trained.cross_fitted(breaths)

    def held_out(self, breaths: Breaths) -> Bools:
        """See :meth:`Simulators.held_out`."""
        return self.trained.held_out(breaths)

    def unseen(self, breaths: Breaths) -> Bools:
        """See :meth:`Simulators.unseen`."""
        return self.trained.unseen(breaths)

    def perhaps_copies(self, breaths: Breaths) -> Bools:
        """See :meth:`Simulators.perhaps_copies`."""
        return self.trained.perhaps_copies(breaths)
