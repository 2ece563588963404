"""Simulators that others wrote in plain Python or NumPy, as functions of one breath's commands.

A simulator may be

- a function ``f(u_in, u_out, dt, *, R, C, initial_pressure)`` that returns the pressures, cmH2O,
  ``(T,)``, at samples with commands of %, 0/1, and times to the next sample, s, ``(T,)``, for the
  label R, cmH2O/(L/s), C, mL/cmH2O, and the first pressure; it may leave out what it does not need,
  and may also ask for ``time``, s, or ``flow``, mL/s, by name;
- a class or an object with ``init(pressure)`` and ``step(state, u_in, u_out, dt)``, which returns
  the next state and the pressure, all of them numbers;
- a class or an object with ``step(u_in, u_out, dt)``, which returns the pressure and keeps its
  state itself. ``reset(...)`` is called before each breath; a class without it is made anew.

Classes are made with those of ``R`` and ``C`` that they take.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.task.interfaces import Plant

#: What a simulator may ask for, in the order of arguments that have other names.
_ARGUMENTS = ("u_in", "u_out", "dt", "R", "C", "initial_pressure", "time", "flow")

#: Arguments that a function must not leave out under other names.
_COMMANDS = 3

_SIGNATURE = "f(u_in, u_out, dt, *, R, C, initial_pressure)"


def is_jax_plant(value: object) -> bool:
    """Whether an object is a plant that JAX can trace: a registered pytree with init and step."""
    if isinstance(value, type) or not isinstance(value, Plant):
        return False
    leaves = jax.tree.leaves(value)
    return not (len(leaves) == 1 and leaves[0] is value)


@dataclass(frozen=True)
class PythonSimulator:
    """A simulator of one breath's commands, in the form that the resolver of simulators calls."""

    name: str  #: what messages call it.
    #: takes the arguments of :data:`_ARGUMENTS` by name.
    run: Callable[[dict[str, Any]], ArrayLike]

    def __call__(
        self, u_in: Floats, u_out: Floats, dt: Floats, /, *, R: float, C: float,
        initial_pressure: float, flow: Floats | None = None,
    ) -> ArrayLike:  # fmt: skip
        """Simulate one breath; see the module. ``flow`` is the recorded one, where there is one."""
        time = np.concatenate([[0.0], np.cumsum(dt)[:-1]])
        return self.run(
            {"u_in": u_in, "u_out": u_out, "dt": dt, "R": R, "C": C,
             "initial_pressure": initial_pressure, "time": time, "flow": flow}
        )  # fmt: skip


def python_simulator(value: Any, name: str) -> PythonSimulator:
    """Adapt a function, a class or an object, see the module; messages call it by the name.

    Raises:
        InputError: if it cannot be called as any of them.
    """
    if hasattr(value, "step"):
        return PythonSimulator(name, _stepping(value, name))
    if isinstance(value, type):
        raise InputError(
            f"{name} is a class without `step`; give it step(u_in, u_out, dt), which returns the "
            "pressure, or init(pressure) and step(state, u_in, u_out, dt)"
        )
    return PythonSimulator(name, _call_of(value, name))


def _call_of(function: Callable[..., Any], name: str) -> Callable[[dict[str, Any]], Any]:
    """Return how to call a function: with what it asks for, by name or in order."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # a function in C tells no signature
        return lambda given: function(
            *(given[key] for key in _ARGUMENTS[:_COMMANDS]),
            **{key: given[key] for key in ("R", "C", "initial_pressure")},
        )
    ordered = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    any_name = any(p.kind is p.VAR_KEYWORD for p in parameters)
    any_number = any(p.kind is p.VAR_POSITIONAL for p in parameters)
    named = [p.name for p in parameters if p.name in _ARGUMENTS and p.kind is not p.POSITIONAL_ONLY]
    # The first three stand for the commands, whatever their names, unless those are known names.
    by_order = any_number and not ordered
    if not by_order:
        by_order = any(p.name not in _ARGUMENTS for p in ordered[:_COMMANDS]) and (
            len(ordered) >= _COMMANDS
        )
    in_order = ordered[:_COMMANDS] if by_order else []
    names = [key for key in named if key not in {p.name for p in in_order}]
    needed = [
        p.name
        for p in parameters
        if p.default is p.empty
        and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
        and p not in in_order
        and p.name not in names
    ]
    if needed:
        raise InputError(
            f"{name} needs {', '.join(needed)}, which a diagnosis does not have; simulators are "
            f"called as {_SIGNATURE}, and may also ask for time (s) and flow (mL/s) by name"
        )
    if any_name:
        names += [key for key in ("R", "C", "initial_pressure") if key not in names]
        if not by_order:
            names += [key for key in _ARGUMENTS[:_COMMANDS] if key not in names]

    def call(given: dict[str, Any]) -> Any:
        if "flow" in names and given["flow"] is None and _is_needed(parameters, "flow"):
            raise InputError(f"{name} asks for flow, which the recording does not have")
        first = [given[key] for key in _ARGUMENTS[:_COMMANDS]] if by_order else []
        return function(*first, **{key: given[key] for key in names})

    return call


def _is_needed(parameters: list[inspect.Parameter], name: str) -> bool:
    return any(p.name == name and p.default is p.empty for p in parameters)


def _stepping(value: Any, name: str) -> Callable[[dict[str, Any]], Floats]:
    """Return how to run a simulator sample by sample."""
    make = _call_with_labels(value, f"{name}()") if isinstance(value, type) else lambda given: value
    owner = value if isinstance(value, type) else type(value)
    has_init = hasattr(value, "init")
    wanted = "step(state, u_in, u_out, dt)" if has_init else "step(u_in, u_out, dt)"
    count = _positional(owner, "step")
    if count is not None and count != (4 if has_init else _COMMANDS):
        raise InputError(f"{name}: step takes {count} arguments; {wanted} is wanted")
    if not has_init and not hasattr(value, "reset") and not isinstance(value, type):
        raise InputError(
            f"{name} is an object with step alone, which would carry its state from breath to "
            "breath; give it reset(initial_pressure), or give the class"
        )

    def run(given: dict[str, Any]) -> Floats:
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


def _call_with_labels(function: Callable[..., Any], name: str) -> Callable[[dict[str, Any]], Any]:
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
