"""Simulators in plain Python or NumPy that others wrote, as :class:`PythonSimulators`.

One may be

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
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.plants.simulators import Simulators
from ventbench.recordings.breaths import Breaths
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import Lung, lung

_NAMES = ("u_in", "u_out", "dt", "R", "C", "initial_pressure", "time", "flow")

#: What a function may ask for, and what a class or ``reset`` may, by the names they may give it.
_ARGUMENTS = {name: name for name in _NAMES}
_LABELS = {
    "R": "R",
    "C": "C",
    "initial_pressure": "initial_pressure",
    "pressure": "initial_pressure",
}
_LABELS_ADVICE = "which a diagnosis does not give; it gives R, C and initial_pressure by name"

_SIGNATURE = "f(u_in, u_out, dt, *, R, C, initial_pressure)"

#: Takes what is known of one breath by the names of :data:`_ARGUMENTS`; pressures, cmH2O.
PythonSimulator = Callable[[Mapping[str, Any]], ArrayLike]


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PythonSimulators(Simulators):
    """A function of whole commands, for any label."""

    function: PythonSimulator
    shortage = "is a function of whole commands, not a plant with init and step"

    def pressures(
        self, breaths: Breaths, *, progress: Callable[[int], object] = lambda count: None
    ) -> Floats:
        """See :meth:`Simulators.pressures`; a function that fails or answers oddly is named."""
        answers = np.full(breaths.pressure.shape, np.nan)
        for i, start in enumerate(breaths.pressure[:, 0].tolist()):
            if np.isfinite(start):
                label = Lung(float(breaths.R[i]), float(breaths.C[i]))
                samples = breaths.valid[i]
                columns = (breaths.u_in, breaths.u_out, breaths.dt)
                u_in, u_out, dt = (x[i, samples] for x in columns)
                flow = None if breaths.flow is None else breaths.flow[i, samples].copy()
                place = f"breath {breaths.breath_id[i]}"
                answer = self._call(u_in, u_out, dt, label, start, place, flow)
                answers[i, samples], answers[i, ~samples] = answer, answer[-1]
            progress(1)
        return answers

    def respond(
        self, lung_id: str, u_in: Floats, u_out: Floats, dt: Floats, *, initial_pressure: float
    ) -> Floats:
        """See :meth:`Simulators.respond`."""
        return self._call(u_in, u_out, dt, lung(lung_id), initial_pressure, "the commands")

    def _call(
        self,
        u_in: Floats,
        u_out: Floats,
        dt: Floats,
        label: Lung,
        start: float,
        place: str,
        flow: Floats | None = None,
    ) -> Floats:
        commands = {"u_in": u_in, "u_out": u_out, "dt": dt}
        arguments: dict[str, Any] = {
            key: np.array(column, float) for key, column in commands.items()
        }
        arguments |= {"R": label.R, "C": label.C, "initial_pressure": float(start), "flow": flow}
        arguments["time"] = np.concatenate([[0.0], np.cumsum(arguments["dt"])[:-1]])
        try:
            pressure = np.asarray(self.function(arguments), float)
        except InputError as error:
            raise InputError(f"{place} of lung {label}: {error}") from error
        except Exception as error:
            raise InputError(
                f"{self.name} raised {type(error).__name__} at {place} of lung {label}: {error}"
            ) from error
        if pressure.shape != np.shape(u_in):
            raise InputError(
                f"{self.name} answered to {place} with shape {pressure.shape}; a pressure for each "
                f"of the {np.size(u_in)} samples is wanted, shape {np.shape(u_in)}"
            )
        if not np.all(np.isfinite(pressure)):
            raise InputError(f"{self.name} answered to {place} with a pressure that is not finite")
        return pressure


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
    return _by_name(
        value,
        name,
        _ARGUMENTS,
        f"which no simulator is given; simulators are called as {_SIGNATURE}, by these names, and "
        "may also ask for time (s) and flow (mL/s)",
    )


def _by_name(
    function: Callable[..., Any], name: str, arguments: Mapping[str, str], advice: str
) -> Callable[[Mapping[str, Any]], Any]:
    """Return how to call a function or class: with those arguments that its signature names.

    Args:
        function: what is called.
        name: what messages call it.
        arguments: what an argument is in what is known of a breath, by the name it may have.
        advice: what to do about a needed argument that has another name.

    Raises:
        InputError: if there is such an argument, or no signature.
    """
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError) as error:  # written in C
        if "u_in" in arguments:
            raise InputError(f"{name} tells no signature; wrap it in a {_SIGNATURE}") from error
        parameters = []
    named = [p.name for p in parameters if p.kind is not p.POSITIONAL_ONLY and p.name in arguments]
    needed = [p.name for p in parameters if _needed(p)]
    if unknown := [key for key in needed if key not in named]:
        raise InputError(f"{name} needs {', '.join(unknown)}, {advice}")

    def call(known: Mapping[str, Any]) -> Any:
        if "flow" in needed and known["flow"] is None:
            raise InputError(f"{name} asks for flow, which the recording does not have")
        return function(**{key: known[arguments[key]] for key in named})

    return call


def _needed(parameter: inspect.Parameter) -> bool:
    """Whether a parameter has no default, and is none of ``*args`` and ``**kwargs``."""
    several = parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
    return parameter.default is parameter.empty and not several


def _stepping(value: Any, name: str) -> PythonSimulator:
    """Return how to run a simulator sample by sample."""
    make = (
        _by_name(value, f"{name}()", _LABELS, _LABELS_ADVICE)
        if isinstance(value, type)
        else lambda known: value
    )
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

    def run(arguments: Mapping[str, Any]) -> Floats:
        simulator: Any = make(arguments)
        pressures = np.empty(len(arguments["u_in"]))
        pressures[0] = start = arguments["initial_pressure"]
        state = simulator.init(start) if has_init else None
        if not has_init and hasattr(simulator, "reset"):
            _by_name(simulator.reset, f"{name}.reset", _LABELS, _LABELS_ADVICE)(arguments)
        columns = (arguments[key].tolist() for key in ("u_in", "u_out", "dt"))
        for k, command in zip(range(1, len(pressures)), zip(*columns, strict=True), strict=False):
            if has_init:
                answer = simulator.step(state, *command)
                if not isinstance(answer, tuple) or len(answer) != 2:
                    raise InputError(f"{name}: step must return the next state and the pressure")
                state, pressure = answer
            else:
                pressure = simulator.step(*command)
            number = np.asarray(pressure, float)
            if number.size != 1:
                raise InputError(
                    f"{name}: step returned a pressure of shape {number.shape}; one number is "
                    "wanted"
                )
            pressures[k] = number.item()
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
    needed = [p for p in parameters if _needed(p)]
    static = isinstance(inspect.getattr_static(owner, method), staticmethod)
    return len(needed) - (0 if static else 1)
