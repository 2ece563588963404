"""One controller in one run: fresh, reset once, asked at every step; it fails by name.

Standard library only: a sandbox's child process uses this module too and need not load numpy.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ventbench.interfaces import Observation, Task
from ventbench.protocol import TARGETS_AHEAD
from ventbench.submissions.errors import Failure
from ventbench.submissions.load import describe, printable

#: Floats of one observation on the way to a controller, in the order of :class:`Observation`.
ROW = 5 + TARGETS_AHEAD


def unpack(row: Sequence[float]) -> Observation:
    """Make an observation of its :data:`ROW` floats."""
    return Observation(row[0], row[1], row[2], row[3], tuple(row[4:-1]), row[-1])


class Failed(Exception):
    """Carries a :class:`Failure` out of a call into the submission."""

    def __init__(self, failure: Failure):
        super().__init__(failure.what)
        self.failure = failure


class Cell:
    """A controller that is asked step by step.

    Args:
        controller: the submission's class.
        task: what it is told.
        folder: of the submission, to name files and lines in it.

    Raises:
        Failed: if it cannot be made or reset.
    """

    def __init__(self, controller: Callable[[], Any], task: Task, folder: Path):
        self._task, self._folder, self._calls = task, folder, 0
        instance = self._call("construct", controller)
        self._call("reset", lambda: instance.reset(task))
        self._act = instance.act

    def act(self, row: Sequence[float]) -> float:
        """Ask for the next command.

        Args:
            row: the observation, :data:`ROW` floats.

        Returns:
            ``u_in``, %, a finite float; clipping is the caller's.

        Raises:
            Failed: if it raises or returns anything but a finite number.
        """
        self._calls += 1
        observation = unpack(row)
        try:
            value = self._act(observation)
        except (Exception, SystemExit) as error:
            raise self._failed("act", *describe(error, self._folder)) from error
        if type(value) is not float:
            value = self._number(value)
        if not math.isfinite(value):
            raise self._failed("value", f"act returned {value}")
        return value

    def _call(self, kind: str, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except (Exception, SystemExit) as error:
            what, detail = describe(error, self._folder)
            when = "Controller()" if kind == "construct" else "reset"
            raise self._failed(kind, f"{what} in {when}", detail) from error

    def _failed(self, kind: str, what: str, detail: str = "") -> Failed:
        if self._calls == 0:
            return Failed(Failure(kind, what, detail))
        breath, step = divmod(self._calls - 1, self._task.inspiration_steps)
        return Failed(Failure(kind, what, detail, breath + 1, step + 1))

    def _number(self, value: Any) -> float:
        number = _plain(value)
        if number is None:
            raise self._failed("type", f"act returned {_name(value)}; it must return one number")
        try:
            return float(number)
        except OverflowError:
            raise self._failed("value", "act returned an integer too large for a float") from None


def _plain(value: Any) -> float | int | None:
    """Return the int or float that a number holds: also of numpy, and an array of shape ``()``."""
    if type(value) in (int, float):
        return value
    # Only types of these packages are asked: `__float__` of anything else is the author's code.
    package = type(value).__module__.partition(".")[0]
    if package in ("numpy", "jax", "jaxlib") and package in sys.modules:
        if getattr(value, "shape", None) != ():
            return None
        item = value.item()
        return item if type(item) in (int, float) else None
    return None


def _name(value: Any) -> str:
    if value is None:
        return "None"
    name, shape = type(value).__name__, getattr(value, "shape", ())
    if isinstance(shape, tuple) and shape:
        return printable(f"an array of shape {shape}", 80)
    return printable(f"a {name} ({value!r})" if type(value) in (bool, str) else f"a {name}", 80)
