"""A submission is a folder: how it is found, what it may hold, what identifies it.

For scoring from Python a class or a function can take its place.
"""

from __future__ import annotations

import difflib
import hashlib
import inspect
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ventbench.base import files
from ventbench.entries.errors import SubmissionError, printable
from ventbench.entries.manifest import MANIFEST, TRACKS, Manifest, manifest_from_json
from ventbench.sandbox.child.sources import CONTROLLER as CONTROLLER
from ventbench.sandbox.child.sources import walk
from ventbench.sandbox.reader import UnreadableError, read_apart
from ventbench.task.interfaces import API_VERSION, Task

#: Largest folder, bytes, and number of files.
MAX_BYTES = 5_000_000
MAX_FILES = 1000

# Written by Python and by desktops, not by the author.
_IGNORED_FOLDERS = {"__pycache__"}
_IGNORED_FILES = {".DS_Store"}


@dataclass(frozen=True)
class Submission:
    """A submission whose folder and manifest are in order; its code has not been touched.

    Attributes:
        label: how the person named it; starts every message.
        folder: absolute path.
        manifest: what ``submission.toml`` says.
        sha256: hash of the folder, see :func:`content_hash`; None for a class or function.
        controller: makes a controller, for a class or function in place of a folder; it can only
            run in this process.
    """

    label: str
    folder: Path
    manifest: Manifest
    sha256: str | None
    controller: Callable[[], Any] | None = None


def bundled() -> list[str]:
    """Names of the submissions that travel with ventbench."""
    folder = files.submissions_folder()
    return sorted(path.parent.name for path in folder.glob(f"*/{MANIFEST}"))


def resolve(name: str) -> Path:
    """Find the folder of a submission.

    Args:
        name: path of a folder, or the name of a bundled submission.

    Raises:
        SubmissionError: if there is neither.
    """
    path = Path(name)
    if path.is_dir():
        return path.resolve()
    if path.is_file():
        raise SubmissionError(f"{name} is a file; give the folder that holds {CONTROLLER}")
    if name in bundled():
        return files.submissions_folder() / name
    close = difflib.get_close_matches(path.name, bundled(), n=1)
    hint = f"did you mean {close[0]}?" if close else f"bundled are {', '.join(bundled())}"
    raise SubmissionError(f"{name}: no such folder and no bundled submission of that name; {hint}")


def open_submission(name: str) -> Submission:
    """Find a submission and check its folder and manifest.

    Args:
        name: path of a folder, or the name of a bundled submission.

    Raises:
        SubmissionError: naming every problem.
    """
    folder = resolve(name)
    problems = []
    paths, size = [], 0
    for path in _walk(folder):
        relative = printable(path.relative_to(folder).as_posix())
        if path.is_symlink():
            problems.append(f"{name}: {relative} is a symbolic link; put the file itself there")
        elif path.is_dir():
            problems.append(f"{name}: {relative} lies in too many folders")
        elif not path.is_file():
            problems.append(f"{name}: {relative} is neither a file nor a folder")
        else:
            paths.append(path)
            size += path.stat().st_size
        if len(paths) > MAX_FILES:
            problems.append(f"{name}: more than {MAX_FILES} files")
            break
    if size > MAX_BYTES:
        problems.append(f"{name}: {size / 1e6:.1f} MB; at most {MAX_BYTES / 1e6:g} MB are accepted")
    for required in (CONTROLLER, MANIFEST):
        if not (folder / required).is_file():
            problems.append(f"{name}: {required} is missing")
    if problems:
        raise SubmissionError(*problems)
    manifest = _manifest(folder, f"{name}/{MANIFEST}".replace("//", "/"))
    return Submission(name.rstrip("/"), folder, manifest, content_hash(folder, paths))


def _manifest(folder: Path, label: str) -> Manifest:
    """Read a manifest in a limited process."""
    try:
        answer = read_apart("ventbench.entries.manifest:read_as_json", folder, [label])
    except UnreadableError as error:
        raise SubmissionError(f"{label}: {error}") from None
    if answer["problems"]:
        raise SubmissionError(*answer["problems"])
    return manifest_from_json(answer["manifest"])


def as_submission(given: Any) -> Submission:
    """Take a folder, the name of a bundled submission, a class or a function as a submission.

    Raises:
        SubmissionError: if there is no such submission, or it is of no such kind.
    """
    if isinstance(given, Submission):
        return given
    if isinstance(given, str | Path):
        return open_submission(str(given))
    return submission_of(given)


def submission_of(controller: Any) -> Submission:
    """Take a class or a function as a submission, to be run in this process.

    Args:
        controller: a class whose instances have ``reset(task)`` and ``act(observation)``, which
            enters both tracks, performance first; or a function from an observation to ``u_in``,
            %, which keeps nothing and is scored for robustness first.

    Raises:
        SubmissionError: if it is neither.
    """
    name = getattr(controller, "__name__", type(controller).__name__)
    if isinstance(controller, type):
        lacks = [m for m in ("reset", "act") if not callable(getattr(controller, m, None))]
        if lacks:
            raise SubmissionError(f"class {name} has no method {' and no method '.join(lacks)}")
        _check_calls(f"class {name}", controller, "nothing to make one")
        for method, given in (("reset", "a task"), ("act", "an observation")):
            _check_calls(f"{name}.{method}", getattr(controller, method), given, "self", given)
        make, tracks = controller, TRACKS
    elif callable(getattr(controller, "act", None)):
        raise SubmissionError(f"give the class {name}, not an instance: each run needs a new one")
    elif callable(controller):
        _check_calls(name, controller, "an observation", "observation")
        function: Any = controller
        make, tracks = (lambda: _Stateless(function)), TRACKS[::-1]
    else:
        raise SubmissionError(
            f"a {name} cannot be scored; give a folder, the name of a bundled submission, a class "
            "with reset and act, or a function from an observation to u_in"
        )
    try:
        file = Path(inspect.getfile(controller)).resolve()
    except (TypeError, OSError):
        file = Path()
    # What was typed at a prompt is in no file: messages then name no line.
    folder = file.parent if file.is_file() else Path(os.devnull)
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    description = (inspect.getdoc(controller) or "").partition("\n")[0]
    manifest = Manifest(plain, (), "", API_VERSION, "other", tracks, description)
    return Submission(name, folder, manifest, None, make)


def _check_calls(name: str, function: Any, given: str, *arguments: str) -> None:
    """Check that a function takes as many arguments as it will be given.

    Raises:
        SubmissionError: if it does not.
    """
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # of compiled code
        return
    try:
        signature.bind(*arguments)
    except TypeError as error:
        raise SubmissionError(f"{name}{signature} must take {given}: {error}") from None


class _Stateless:
    """A function of the observation as a controller."""

    def __init__(self, function: Callable[..., Any]):
        self.act = function

    def reset(self, task: Task) -> None:
        """Keep nothing of a task."""


def _walk(folder: Path) -> list[Path]:
    paths = []
    for parent, folders, names in walk(folder):
        links = [name for name in folders if (parent / name).is_symlink()]
        folders[:] = sorted(set(folders) - _IGNORED_FOLDERS - set(links))
        paths += [parent / name for name in (*links, *names) if name not in _IGNORED_FILES]
    return sorted(paths)


def content_hash(folder: Path, paths: list[Path]) -> str:
    """SHA-256 of the names and contents of a submission's files.

    Of the text that ``sha256sum`` prints for the files, sorted by relative path:
    ``HASH  PATH`` a line.
    """
    return combined_hash({p.relative_to(folder).as_posix(): files.sha256(p) for p in paths})


def file_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a submission now, by relative path; links are left out."""
    paths = [path for path in _walk(folder) if path.is_file() and not path.is_symlink()]
    return {path.relative_to(folder).as_posix(): files.sha256(path) for path in paths}


def combined_hash(hashes: dict[str, str]) -> str:
    """Return :func:`content_hash` of files whose own hashes are known, by relative path."""
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(hashes.items()))
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()
