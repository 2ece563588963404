"""Simulators of lungs, whatever they were given as: what all commands and reports talk to.

One that others wrote in plain Python or NumPy may be

- a function ``f(u_in, u_out, dt, *, R, C, initial_pressure)`` that returns the pressures, cmH2O,
  ``(T,)``, at samples with commands of %, 0/1, and times to the next sample, s, ``(T,)``, for the
  label R, cmH2O/(L/s), C, mL/cmH2O, and the first pressure; it may leave out what it does not need,
  and may also ask for ``time``, s, or ``flow``, mL/s. It gets them by these names;
- a class or an object with ``init(pressure)`` and ``step(state, u_in, u_out, dt)``, which returns
  the next state and the pressure, all of them numbers;
- a class or an object with ``step(u_in, u_out, dt)``, which returns the pressure and keeps its
  state itself. ``reset(...)`` is called before each breath; a class without it is made anew.

Classes are made with those of ``R`` and ``C`` that they take.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.plants import frozen
from ventbench.plants.stacking import PlantsFor, VmappedPlant, open_loop_breaths, take
from ventbench.recordings.breaths import Breaths
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung, lung
from ventbench.task.rollouts import open_loop


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
    _answers: Callable[[Breaths], Floats] | None = field(default=None, repr=False)
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
            with compilation.float64():
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
        with compilation.float64():
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
        if self._function is not None:
            return self._by_function(self._function, breaths, progress)
        if self._answers is not None:
            answers = self._answers(breaths)
            answers[~np.isfinite(breaths.pressure[:, 0])] = np.nan
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
        with compilation.float64():
            commands = (jnp.asarray(column, float)[None] for column in (u_in, u_out, dt))
            start = jnp.asarray([float(initial_pressure)])
            return np.asarray(open_loop(plant, start, *commands))[0]

    @property
    def _without_plants(self) -> str:
        if self.kind == "function":
            return f"{self.name} is a function of whole commands, not a plant with init and step."
        return f"{self.name} holds simulated pressures of recorded breaths, not a simulator."

    def _by_function(
        self,
        function: PythonSimulator,
        breaths: Breaths,
        progress: Callable[[int], object] | None,
    ) -> Floats:
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
        self,
        function: PythonSimulator,
        u_in: Floats,
        u_out: Floats,
        dt: Floats,
        label: Lung,
        start: float,
        what: str,
        flow: Floats | None = None,
    ) -> Floats:
        commands = {"u_in": u_in, "u_out": u_out, "dt": dt}
        given: dict[str, Any] = {key: np.array(column, float) for key, column in commands.items()}
        given |= {"R": label.R, "C": label.C, "initial_pressure": float(start), "flow": flow}
        given["time"] = np.concatenate([[0.0], np.cumsum(given["dt"])[:-1]])
        try:
            pressure = np.asarray(function(given), float)
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


#: What a simulator may ask for, by name.
_ARGUMENTS = ("u_in", "u_out", "dt", "R", "C", "initial_pressure", "time", "flow")

_SIGNATURE = "f(u_in, u_out, dt, *, R, C, initial_pressure)"

#: Takes what is known of one breath by the names of :data:`_ARGUMENTS`; pressures, cmH2O.
PythonSimulator = Callable[[Mapping[str, Any]], ArrayLike]


def is_jax_plant(value: object) -> bool:
    """Whether an object is a plant that JAX can trace: a registered pytree with init and step."""
    if isinstance(value, type) or not isinstance(value, Plant):
        return False
    leaves = jax.tree.leaves(value)
    return not (len(leaves) == 1 and leaves[0] is value)


def python_simulator(value: Any, name: str) -> PythonSimulator:
    """Adapt a function, a class or an object, see the module; messages call it by the name.

    Raises:
        InputError: if it cannot be called as any of them.
    """
    if hasattr(value, "step"):
        return _stepping(value, name)
    if isinstance(value, type):
        raise InputError(
            f"{name} is a class without `step`; give it step(u_in, u_out, dt), which returns the "
            "pressure, or init(pressure) and step(state, u_in, u_out, dt)"
        )
    return _call_of(value, name)


def _call_of(function: Callable[..., Any], name: str) -> PythonSimulator:
    """Return how to call a function: with those of :data:`_ARGUMENTS` that it names."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError) as error:  # a function in C
        raise InputError(f"{name} tells no signature; wrap it in a {_SIGNATURE}") from error
    needed = {
        key
        for key, p in parameters.items()
        if p.default is p.empty and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
    }
    by_name = {key for key, p in parameters.items() if p.kind is not p.POSITIONAL_ONLY}
    names = by_name & set(_ARGUMENTS)
    if unknown := [key for key in parameters if key in needed - names]:
        raise InputError(
            f"{name} needs {', '.join(unknown)}, which no simulator is given; simulators are "
            f"called as {_SIGNATURE}, by these names, and may also ask for time (s) and flow (mL/s)"
        )

    def call(given: Mapping[str, Any]) -> Any:
        if "flow" in needed and given["flow"] is None:
            raise InputError(f"{name} asks for flow, which the recording does not have")
        return function(**{key: given[key] for key in names})

    return call


def _stepping(value: Any, name: str) -> PythonSimulator:
    """Return how to run a simulator sample by sample."""
    make = _call_with_labels(value, f"{name}()") if isinstance(value, type) else lambda given: value
    owner = value if isinstance(value, type) else type(value)
    has_init = hasattr(value, "init")
    wanted = "step(state, u_in, u_out, dt)" if has_init else "step(u_in, u_out, dt)"
    count = _positional(owner, "step")
    if count is not None and count != (4 if has_init else 3):
        raise InputError(f"{name}: step takes {count} arguments; {wanted} is wanted")
    if not has_init and not hasattr(value, "reset") and not isinstance(value, type):
        raise InputError(
            f"{name} is an object with step alone, which would carry its state from breath to "
            "breath; give it reset(initial_pressure), or give the class"
        )

    def run(given: Mapping[str, Any]) -> Floats:
        simulator = make(given)
        pressures = np.empty(len(given["u_in"]))
        pressures[0] = start = given["initial_pressure"]
        commands = zip(
            given["u_in"].tolist(), given["u_out"].tolist(), given["dt"].tolist(), strict=True
        )
        if has_init:
            state = simulator.init(start)
            for k, command in zip(range(1, len(pressures)), commands, strict=False):
                answer = simulator.step(state, *command)
                if not isinstance(answer, tuple) or len(answer) != 2:
                    raise InputError(f"{name}: step must return the next state and the pressure")
                state, pressures[k] = answer[0], _number(answer[1], name)
            return pressures
        if hasattr(simulator, "reset"):
            _call_with_labels(simulator.reset, f"{name}.reset")(given)
        for k, command in zip(range(1, len(pressures)), commands, strict=False):
            pressures[k] = _number(simulator.step(*command), name)
        return pressures

    return run


def _positional(owner: type, method: str) -> int | None:
    """Number of arguments of a method without ``self``; None if it cannot be told."""
    try:
        parameters = list(inspect.signature(getattr(owner, method)).parameters.values())
    except (TypeError, ValueError):
        return None
    if any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return None
    needed = [p for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    static = isinstance(inspect.getattr_static(owner, method), staticmethod)
    return len(needed) - (0 if static else 1)


def _call_with_labels(
    function: Callable[..., Any], name: str
) -> Callable[[Mapping[str, Any]], Any]:
    """Call a class or ``reset`` with those of R, C and the first pressure that it takes."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        parameters = []
    aliases = {"pressure": "initial_pressure"}
    keys, unknown = {}, []
    for p in parameters:
        key = aliases.get(p.name, p.name)
        if key in ("R", "C", "initial_pressure"):
            keys[p.name] = key
        elif p.default is p.empty and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL):
            unknown.append(p.name)
    if unknown:
        raise InputError(
            f"{name} needs {', '.join(unknown)}; a diagnosis gives R, C and initial_pressure by "
            "name"
        )
    return lambda given: function(**{own: given[key] for own, key in keys.items()})


def _number(value: Any, name: str) -> float:
    array = np.asarray(value, float)
    if array.size != 1:
        raise InputError(
            f"{name}: step returned a pressure of shape {array.shape}; one number is wanted"
        )
    return float(array.reshape(()))
