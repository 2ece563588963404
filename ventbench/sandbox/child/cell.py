"""One controller in one run: imported, reset once, asked at every step; it fails by name.

Standard library only: a sandbox's child process uses this module too and need not load numpy.
"""

from __future__ import annotations

import codecs
import contextlib
import dataclasses
import itertools
import math
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ventbench.base.errors import InputError
from ventbench.task.interfaces import Observation, Task
from ventbench.task.protocol import TARGETS_AHEAD


def printable(text: str, length: int = 300) -> str:
    """One line that no terminal or page misreads: other characters escaped, cut to a length."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return text if len(text) <= length else text[: length - 3] + "..."


class SubmissionError(InputError):
    """A submission that cannot be run at all.

    Attributes:
        problems: one sentence for each, with file and key or line.
    """

    def __init__(self, *problems: str):
        self.problems = problems
        super().__init__("\n".join(problems))


@dataclass(frozen=True)
class Failure:
    """One controller that failed during a run; its entry is listed, not ranked."""

    #: ``"construct"``, ``"reset"``, ``"act"`` (it raised there), ``"type"`` (no number),
    #: ``"value"`` (NaN or infinite); a sandbox adds its own, such as ``"timeout"``.
    kind: str
    what: str  #: what happened, such as ``"controller.py line 7 raised ValueError"``.
    detail: str = ""  #: the exception's text, or empty.
    breath: int | None = None  #: counted from 1; None before the first step.
    step: int | None = None  #: of the breath, counted from 1; None before the first step.
    #: the exception, of code that runs in this process; not part of a record.
    cause: BaseException | None = dataclasses.field(default=None, repr=False, compare=False)

    def message(self, submission: str, lung: str | None) -> str:
        """One sentence for a person, with the folder as written and the lung's id, if known."""
        when = "" if self.step is None else f" at step {self.step} of breath {self.breath}"
        detail = f": {self.detail}" if self.detail else ""
        where = f"(lung {lung or 'hidden'})"
        return f"{submission}: {self.what}{when} {where}{detail}; the entry is not ranked."

    def to_json(self) -> dict[str, Any]:
        """Return the attributes as JSON values, without the exception."""
        values = dataclasses.asdict(dataclasses.replace(self, cause=None))
        return {name: value for name, value in values.items() if name != "cause"}


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
    """A controller that is asked step by step; made of a class, and told a task.

    Messages name files and lines in the submission's folder, and ``source`` where none is to blame.

    Raises:
        Failed: if it cannot be made or reset.
    """

    def __init__(
        self, controller: Callable[[], Any], task: Task, folder: Path, source: str | None = None
    ):
        self._task, self._folder, self._calls = task, folder, 0
        self._source = source or FILE
        instance = self._call("construct", controller)
        self._call("reset", lambda: instance.reset(task))
        self._act = instance.act

    def act(self, row: Sequence[float]) -> float:
        """Ask for the next command, by an observation of :data:`ROW` floats.

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
            raise self._failed("act", *describe(error, self._folder, self._source)) from error
        if type(value) is not float:
            value = self._number(value)
        if not math.isfinite(value):
            raise self._failed("value", f"act returned {value}")
        return value

    def _call(self, kind: str, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except (Exception, SystemExit) as error:
            what, detail = describe(error, self._folder, self._source)
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
        number = value.item()
        return number if type(number) in (int, float) else None
    return None


def _name(value: Any) -> str:
    if value is None:
        return "None"
    name, shape = type(value).__name__, getattr(value, "shape", ())
    if isinstance(shape, tuple) and shape:
        return printable(f"an array of shape {shape}", 80)
    return printable(f"a {name} ({value!r})" if type(value) in (bool, str) else f"a {name}", 80)


#: File and class of every submission.
FILE = "controller.py"
CLASS = "Controller"

_serial = itertools.count()


def controller_class(folder: Path, label: str | None = None) -> Callable[[], Any]:
    """Import a submission and return its class ``Controller``.

    The module gets a name of its own, so that several submissions live side by side. It may import
    other modules of its folder, at the top of a file: the folder is on the module search path only
    until the import ends. Nothing is written into the folder.

    The code runs in this process with all its rights: only for code that is trusted, or in a
    sandbox.

    Raises:
        SubmissionError: if it cannot be imported, or lacks the class or a method; with file and
            line where there is one.
    """
    label = label or str(folder)
    path = folder / FILE
    try:
        code = compile(source_text(path.read_bytes()), str(path), "exec", dont_inherit=True)
    except SyntaxError as error:
        line = f" line {error.lineno}" if error.lineno else ""
        raise SubmissionError(f"{label}: {FILE}{line}: {error.msg}") from None
    except (OSError, ValueError) as error:  # ValueError: null bytes
        raise SubmissionError(f"{label}: {FILE} cannot be read: {error}") from None

    module = types.ModuleType(f"_ventbench_submission_{next(_serial)}")
    module.__file__ = str(path)
    with contextlib.ExitStack() as undo:
        sys.modules[module.__name__] = module  # dataclasses look up their module there
        undo.callback(sys.modules.pop, module.__name__, None)
        try:
            with _search_path(folder):
                exec(code, module.__dict__)
        except (Exception, SystemExit) as error:
            what, detail = describe(error, folder)
            raise SubmissionError(f"{label}: {what} while it was imported: {detail}") from error
        controller = _checked(vars(module), label)
        undo.pop_all()
    return controller


def source_text(content: bytes) -> str:
    """Text of a Python source, read as UTF-8 whatever encoding it names.

    A source that names another one reads otherwise for Python than for people: in
    ``unicode_escape`` the end of a comment may be code.

    Raises:
        ValueError: if it is not UTF-8.
    """
    return content.removeprefix(codecs.BOM_UTF8).decode("utf-8")


def _checked(names: Mapping[str, Any], label: str) -> Callable[[], Any]:
    """The class among the names of a module."""
    controller = names.get(CLASS)
    if controller is None:
        module_name = names.get("__name__")
        local = [
            x.__name__
            for x in names.values()
            if isinstance(x, type) and x.__module__ == module_name
        ]
        instead = f", but {', '.join(local[:3])}" if local else ""
        raise SubmissionError(f"{label}: {FILE} defines no class {CLASS}{instead}")
    if not callable(controller):
        raise SubmissionError(
            f"{label}: {CLASS} in {FILE} is a {type(controller).__name__}, no class"
        )
    methods = {"reset": "reset(task)", "act": "act(observation)"}
    missing = [m for k, m in methods.items() if not callable(getattr(controller, k, None))]
    if missing:
        problems = (f"{label}: class {CLASS} in {FILE} has no method {m}" for m in missing)
        raise SubmissionError(*problems)
    return controller


@contextlib.contextmanager
def _search_path(folder: Path) -> Iterator[None]:
    """Let modules of the folder be imported, and forget them afterwards."""
    local = {path.stem for path in folder.iterdir()}

    def theirs() -> dict[str, types.ModuleType]:
        # A copy of the names: an import in another thread may add some.
        return {k: v for k, v in list(sys.modules.items()) if k.partition(".")[0] in local}

    hidden = theirs()
    for name in hidden:
        del sys.modules[name]
    entry, no_bytecode = str(folder), sys.dont_write_bytecode
    sys.path.insert(0, entry)
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        sys.dont_write_bytecode = no_bytecode
        if entry in sys.path:
            sys.path.remove(entry)
        sys.path_importer_cache.pop(entry, None)
        for name in theirs():
            del sys.modules[name]
        sys.modules.update(hidden)


def describe(error: BaseException, folder: Path, source: str | None = None) -> tuple[str, str]:
    """Say where in the submission's folder an exception was raised, and what it says.

    ``source`` names what raised it elsewhere. Such as ``"controller.py line 12 raised ValueError"``
    and ``"no gains for R5C10"``; both printable and short.
    """
    place = source or FILE
    trace = error.__traceback__
    while trace is not None:
        with contextlib.suppress(ValueError):
            file = Path(trace.tb_frame.f_code.co_filename).relative_to(folder)
            place = f"{file.as_posix()} line {trace.tb_lineno}"
        trace = trace.tb_next
    try:
        text = str(error)
    except Exception:
        text = "(its text cannot be shown)"
    return printable(f"{place} raised {type(error).__name__}"), printable(text)
