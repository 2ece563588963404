"""Importing ``controller.py`` from its folder without leaving traces in the interpreter."""

from __future__ import annotations

import contextlib
import itertools
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ventbench.submissions.errors import SubmissionError

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

    Args:
        folder: of the submission.
        label: how messages name it; the folder if not given.

    Raises:
        SubmissionError: if it cannot be imported, or lacks the class or a method; with file and
            line where there is one.
    """
    label = label or str(folder)
    path = folder / FILE
    try:
        code = compile(path.read_bytes(), str(path), "exec", dont_inherit=True)
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
        found = _checked(getattr(module, CLASS, None), label)
        undo.pop_all()
    return found


def _checked(found: Any, label: str) -> Callable[[], Any]:
    if found is None:
        raise SubmissionError(f"{label}: {FILE} defines no class {CLASS}")
    if not callable(found):
        raise SubmissionError(f"{label}: {CLASS} in {FILE} is a {type(found).__name__}, no class")
    missing = [m for m in ("reset(task)", "act(observation)") if not _has(found, m)]
    if missing:
        problems = (f"{label}: class {CLASS} in {FILE} has no method {m}" for m in missing)
        raise SubmissionError(*problems)
    return found


def _has(found: Any, method: str) -> bool:
    return callable(getattr(found, method.partition("(")[0], None))


@contextlib.contextmanager
def _search_path(folder: Path) -> Iterator[None]:
    """Let modules of the folder be imported, and forget them afterwards."""
    own = {path.stem for path in folder.iterdir()}

    def theirs() -> dict[str, types.ModuleType]:
        # A copy of the names: an import in another thread may add some.
        return {k: v for k, v in list(sys.modules.items()) if k.partition(".")[0] in own}

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


def describe(error: BaseException, folder: Path) -> tuple[str, str]:
    """Say where in the submission an exception was raised, and what it says.

    Returns:
        Such as ``"controller.py line 12 raised ValueError"`` and ``"no gains for R5C10"``; both
        printable and short.
    """
    place = FILE
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


def printable(text: str, length: int = 300) -> str:
    """One line that no terminal or page misreads: other characters escaped, cut to a length."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return text if len(text) <= length else text[: length - 3] + "..."
