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

#: What a simulator may ask for, by name.
_ARGUMENTS = ("u_in", "u_out", "dt", "R", "C", "initial_pressure", "time", "flow")

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

    def call(arguments: Mapping[str, Any]) -> Any:
        if "flow" in needed and arguments["flow"] is None:
            raise InputError(f"{name} asks for flow, which the recording does not have")
        return function(**{key: arguments[key] for key in names})

    return call


def _stepping(value: Any, name: str) -> PythonSimulator:
    """Return how to run a simulator sample by sample."""
    make = (
        _call_with_labels(value, f"{name}()")
        if isinstance(value, type)
        else lambda arguments: value
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
        simulator = make(arguments)
        pressures = np.empty(len(arguments["u_in"]))
        pressures[0] = start = arguments["initial_pressure"]
        commands = zip(
            arguments["u_in"].tolist(),
            arguments["u_out"].tolist(),
            arguments["dt"].tolist(),
            strict=True,
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
            _call_with_labels(simulator.reset, f"{name}.reset")(arguments)
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
    return lambda arguments: function(
        **{argument: arguments[key] for argument, key in keys.items()}
    )


def _number(value: Any, name: str) -> float:
    array = np.asarray(value, float)
    if array.size != 1:
        raise InputError(
            f"{name}: step returned a pressure of shape {array.shape}; one number is wanted"
        )
    return float(array.reshape(()))
