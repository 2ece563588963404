"""Simulators of lungs, whatever they were given as: what all commands and reports talk to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import precision
from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.plants import frozen
from ventbench.plants.python_simulator import PythonSimulator
from ventbench.plants.stacking import PlantsFor, VmappedPlant, open_loop_breaths, take
from ventbench.recordings.breaths import Breaths
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung, lung
from ventbench.task.rollouts import open_loop

#: Commands of a table of simulated pressures may differ from the recorded ones by rounding, %.
_SAME_COMMAND = 0.05


@dataclass(frozen=True, eq=False)
class Simulators:
    """Simulators of lungs, whatever they were given as."""

    #: what they are. ``"function"`` answers to commands, ``"pressures"`` only to the recorded
    #: commands of its own breaths; all others have plants: ``"plants"`` are those of the caller or
    #: of a file, and else it is the name, such as ``"frozen"``.
    kind: str
    name: str  #: what messages and reports call them.
    about: Mapping[str, Any]  #: JSON values that results keep of them: version, file, hashes.
    #: lungs for which :attr:`stacked` has plants, in its order; empty where there is none.
    lungs: tuple[Lung, ...] = ()
    #: SHA-256 of the file or manifest that they come from; None if there is none.
    sha256: str | None = None
    official: frozen.Frozen | None = None  #: the official set if they are it, else None.
    _stack: Callable[[], Plant] | None = None
    _for_breaths: PlantsFor | None = None
    _cross_fitted: PlantsFor | None = None
    _training: frozen.Frozen | None = field(default=None, repr=False)
    _make: Callable[[Lung], Plant] | None = None
    _function: PythonSimulator | None = None
    _table: Mapping[int, tuple[Lung, Floats, Floats]] = field(default_factory=dict, repr=False)
    #: JSON values that a file of plants says of its making, such as the recording that they were
    #: fitted to and its breaths that no fit has seen.
    origin: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __repr__(self) -> str:
        """Name, kind and lungs."""
        lungs = ", ".join(lung.id for lung in self.lungs) or "lungs by their label"
        return f"<Simulators {self.name} ({self.kind}): {lungs}>"

    @property
    def has_plants(self) -> bool:
        """Whether there are plants, which can be scored and corrected."""
        return self._for_breaths is not None

    @property
    def is_base_physics(self) -> bool:
        """Whether they are the base model of :mod:`ventbench.physics` at the labels, no more."""
        return self.kind == "physics"

    @cached_property
    def stacked(self) -> Plant:
        """One plant whose leaves have :attr:`lungs` on their leading axis, ``(L, ...)``.

        Raises:
            InputError: if there are only pressures or a function, or the plants of the lungs
                cannot be run together.
        """
        if self._stack is None:
            raise InputError(f"{self._without_plants} It cannot run in a closed loop.")
        return self._stack()

    @property
    def ensemble(self) -> Plant:
        """Plants of all members, leaves ``(members, L, ...)``; one member if there is no ensemble.

        Raises:
            InputError: as :attr:`stacked`.
        """
        if self.kind == "frozen" and self._training is not None:
            return self._training.ensemble
        return jax.tree.map(lambda leaf: np.asarray(leaf)[None], self.stacked)

    def plant(self, lung_id: str) -> Plant:
        """Return the plant of one lung.

        Raises:
            InputError: if there is none.
        """
        wanted = lung(lung_id).id
        if self._make is not None:
            with precision.float64():
                return jax.tree.map(np.asarray, self._make(lung(wanted)))
        stacked, known = self.stacked, [entry.id for entry in self.lungs]
        if wanted not in known:
            raise InputError(
                f"--lung {lung_id}: the simulators {self.name} have {', '.join(known)}"
            )
        return take(stacked, known.index(wanted))

    def for_breaths(self, breaths: Breaths) -> Plant:
        """Plants of n recorded breaths, by lung and, where it matters, by rig; leaves ``(n, ...)``.

        Raises:
            InputError: if there are no plants, or none for a lung of the recording.
        """
        if self._for_breaths is None:
            raise InputError(self._without_plants)
        return self._for_breaths(breaths)

    def cross_fitted(self, breaths: Breaths) -> Plant:
        """Plants that have not been trained on the breaths where there are such.

        The same as :meth:`for_breaths` for simulators that are not learned.
        """
        return (self._cross_fitted or self.for_breaths)(breaths)

    def plant_of_breath(self, breaths: Breaths, index: int) -> Plant:
        """Return the plant of one recorded breath, without a leading axis; float64 leaves."""
        with precision.float64():
            stacked = self.for_breaths(breaths.select([index]))
            inner = stacked.plants if isinstance(stacked, VmappedPlant) else stacked
            return take(inner, 0)

    def held_out(self, breaths: Breaths) -> Bools:
        """Whether :meth:`cross_fitted` gives a plant that has not seen the breath, ``(n,)``."""
        if self._training is None:
            return np.ones(len(breaths), bool)
        return self._training.held_out(breaths)

    def unseen(self, breaths: Breaths) -> Bools:
        """Whether :meth:`for_breaths` gives a plant that has not seen the breath, ``(n,)``."""
        if self._training is None:
            return np.ones(len(breaths), bool)
        return self._training.unseen(breaths)

    def perhaps_copies(self, breaths: Breaths) -> Bools:
        """Whether the breath is perhaps one of the training, which blank pressures hide, (n,)."""
        if self._training is None:
            return np.zeros(len(breaths), bool)
        return self._training.perhaps_copies(breaths)

    def pressures(
        self, breaths: Breaths, *, cross_fitted: bool = False,
        progress: Callable[[int], object] | None = None,
    ) -> Floats:  # fmt: skip
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
        if self._function is not None:
            return self._by_function(self._function, breaths, progress)
        if self._for_breaths is None:
            answers = self._by_table(breaths)
            if progress is not None:
                progress(len(breaths))
            return answers
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
        if self._function is not None:
            return self._call(
                self._function, u_in, u_out, dt, lung(lung_id), initial_pressure, "the commands"
            )
        plant = self.plant(lung_id)
        with precision.float64():
            commands = (jnp.asarray(column, float)[None] for column in (u_in, u_out, dt))
            start = jnp.asarray([float(initial_pressure)])
            return np.asarray(open_loop(plant, start, *commands))[0]

    @property
    def _without_plants(self) -> str:
        if self.kind == "function":
            return f"{self.name} is a function of whole commands, not a plant with init and step."
        return f"{self.name} holds simulated pressures of recorded breaths, not a simulator."

    def _by_function(
        self, function: PythonSimulator, breaths: Breaths,
        progress: Callable[[int], object] | None,
    ) -> Floats:  # fmt: skip
        answers = np.full(breaths.pressure.shape, np.nan)
        for i, start in enumerate(breaths.pressure[:, 0].tolist()):
            if np.isfinite(start):
                label = Lung(float(breaths.R[i]), float(breaths.C[i]))
                samples = breaths.valid[i]
                u_in, u_out, dt = breaths.u_in[i], breaths.u_out[i], breaths.dt[i]
                flow = None if breaths.flow is None else breaths.flow[i, samples].copy()
                what = f"breath {breaths.breath_id[i]}"
                answer = self._call(
                    function, u_in[samples], u_out[samples], dt[samples], label, start, what, flow
                )
                answers[i, samples], answers[i, ~samples] = answer, answer[-1]
            if progress is not None:
                progress(1)
        return answers

    def _call(
        self, function: PythonSimulator, u_in: Floats, u_out: Floats, dt: Floats, label: Lung,
        start: float, what: str, flow: Floats | None = None,
    ) -> Floats:  # fmt: skip
        try:
            answer = function(
                np.array(u_in, float), np.array(u_out, float), np.array(dt, float),
                R=label.R, C=label.C, initial_pressure=float(start), flow=flow,
            )  # fmt: skip
            pressure = np.asarray(answer, float)
        except InputError as error:
            raise InputError(f"{what} of lung {label}: {error}") from error
        except Exception as error:
            raise InputError(
                f"{self.name} raised {type(error).__name__} at {what} of lung {label}: {error}"
            ) from error
        if pressure.shape != np.shape(u_in):
            raise InputError(
                f"{self.name} answered to {what} with shape {pressure.shape}; a pressure for each "
                f"of the {np.size(u_in)} samples is wanted, shape {np.shape(u_in)}"
            )
        if not np.all(np.isfinite(pressure)):
            raise InputError(f"{self.name} answered to {what} with a pressure that is not finite")
        return pressure

    def _by_table(self, breaths: Breaths) -> Floats:
        answers = np.full(breaths.pressure.shape, np.nan)
        for i, number in enumerate(breaths.breath_id.tolist()):
            if number not in self._table:
                raise InputError(f"{self.name} has no breath {number} of the recording")
            label, u_in, pressure = self._table[number]
            samples = int(np.count_nonzero(breaths.valid[i]))
            if label.id != breaths.lung_ids[i] or len(pressure) != samples:
                raise InputError(
                    f"{self.name}: breath {number} is of lung {label} with {len(pressure)} "
                    f"samples, in the recording of {breaths.lung_ids[i]} with {samples}"
                )
            apart = np.abs(u_in - breaths.u_in[i, :samples])
            if apart.max() > _SAME_COMMAND:
                raise InputError(
                    f"{self.name}: breath {number} has another command than the recording, u_in "
                    f"{u_in[apart.argmax()]:g} at sample {apart.argmax() + 1}; simulate the "
                    "recorded commands"
                )
            if np.isfinite(breaths.pressure[i, 0]):
                answers[i, :samples] = pressure
                answers[i, samples:] = pressure[-1]
        return answers
