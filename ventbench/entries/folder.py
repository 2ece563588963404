"""A submission is a folder: how it is found, what it may hold, what identifies it.

For scoring from Python a class or a function can take its place. Checks of names, kinds, sizes, and
of weights that are plain numbers run and import nothing, and unpickle no array.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
import re
import shutil
import stat
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ventbench.base import files
from ventbench.base.text import suggestion
from ventbench.entries.manifest import MANIFEST, RULES, TRACKS, Finding, Manifest, by_word
from ventbench.sandbox.child.cell import SubmissionError
from ventbench.sandbox.child.sources import CONTROLLER as CONTROLLER
from ventbench.sandbox.child.sources import walk
from ventbench.sandbox.reader import UnreadableError, read_apart
from ventbench.task.interfaces import API_VERSION, Task

#: Largest folder, bytes, and number of files.
MAX_BYTES = 5_000_000
MAX_FILES = 1000

#: Folder of a submission with a folder for each seed of its training, and most of them: the weights
#: of one stand for those of the submission, so that a round tells how much a seed is worth.
SEEDS, MAX_SEEDS = "seeds", 10

# Written by Python and by desktops, not by the author.
_IGNORED_FOLDERS, _IGNORED_FILES = {"__pycache__"}, {".DS_Store"}


@dataclass(frozen=True)
class Submission:
    """A submission whose folder and manifest are in order; its code has not been touched."""

    label: str  #: how the person named it; starts every message.
    folder: Path  #: absolute path.
    manifest: Manifest  #: what ``submission.toml`` says.
    #: hash of the folder, see :func:`combined_hash`; None for a class or function.
    sha256: str | None
    #: makes a controller, for a class or function in place of a folder; it can only run in this
    #: process.
    controller: Callable[[], Any] | None = None


def bundled() -> list[str]:
    """Names of the submissions that travel with ventbench."""
    folder = files.submissions_folder()
    return sorted(path.parent.name for path in folder.glob(f"*/{MANIFEST}"))


def resolve(name: str) -> Path:
    """Find the folder of a submission by its path, or by the name of a bundled one.

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
    hint = suggestion(path.name, bundled()) or f"; bundled are {', '.join(bundled())}"
    raise SubmissionError(f"{name}: no such folder and no bundled submission of that name{hint}")


def seeds(folder: Path) -> list[Path]:
    """Folders of the seeds of a submission's training, by name; empty if it has none."""
    inside = (folder / SEEDS).iterdir() if (folder / SEEDS).is_dir() else ()
    return sorted(path for path in inside if path.is_dir() and path.name not in _IGNORED_FOLDERS)


def open_submission(name: str) -> Submission:
    """Find a submission as :func:`resolve` does, and check its folder and manifest.

    Raises:
        SubmissionError: naming every problem.
    """
    folder = resolve(name)
    _, findings = _inventory(folder, _walk(folder))
    problems = [f"{name}: {f.file} {f.what}; {f.advice}" for f in findings]
    problems.extend(
        f"{name}: {required} is missing"
        for required in (CONTROLLER, MANIFEST)
        if not (folder / required).is_file()
    )
    if problems:
        raise SubmissionError(*problems)
    label = f"{name}/{MANIFEST}".replace("//", "/")
    try:
        answer = read_apart("ventbench.entries.manifest:read_as_json", folder, [label])
    except UnreadableError as error:
        raise SubmissionError(f"{label}: {error}") from None
    if answer["problems"]:
        raise SubmissionError(*answer["problems"])
    manifest = msgspec.convert(answer["manifest"], Manifest)
    return Submission(name.rstrip("/"), folder, manifest, combined_hash(file_hashes(folder)))


def as_submission(source: Any) -> Submission:
    """Take a folder, the name of a bundled submission, a class or a function as a submission.

    Raises:
        SubmissionError: if there is no such submission, or it is of no such kind.
    """
    if isinstance(source, Submission):
        return source
    if isinstance(source, str | Path):
        return open_submission(str(source))
    return submission_of(source)


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
        for method, expected in (("reset", "a task"), ("act", "an observation")):
            _check_calls(
                f"{name}.{method}", getattr(controller, method), expected, "self", expected
            )
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


def _check_calls(name: str, function: Any, expected: str, *arguments: str) -> None:
    """Check that a function takes as many arguments as it will be given."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # of compiled code
        return
    try:
        signature.bind(*arguments)
    except TypeError as error:
        raise SubmissionError(f"{name}{signature} must take {expected}: {error}") from None


class _Stateless:
    """A function of the observation as a controller."""

    def __init__(self, function: Callable[..., Any]):
        self.act = function

    def reset(self, task: Task) -> None:
        """Keep nothing of a task."""


def _listed(folder: Path, ignored: set[str], *, hidden: bool = False) -> Iterator[Path]:
    """Files and links below a folder, but for ignored folders; ``hidden`` ones as one each."""
    for parent, folders, names in walk(folder):
        closed = [
            name
            for name in folders
            if (parent / name).is_symlink() or (hidden and name.startswith("."))
        ]
        folders[:] = sorted(set(folders) - ignored - set(closed))
        yield from (parent / name for name in sorted((*closed, *names)))


def _walk(folder: Path) -> list[Path]:
    paths = _listed(folder, _IGNORED_FOLDERS)
    return sorted(path for path in paths if path.name not in _IGNORED_FILES)


def file_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a submission now, by relative path; links are left out."""
    paths = [path for path in _walk(folder) if path.is_file() and not path.is_symlink()]
    return {path.relative_to(folder).as_posix(): files.sha256(path) for path in paths}


def uncovered(folder: Path) -> list[str]:
    """What lies in a folder and is not in its hash: links, caches, compiled code, by path."""
    covered = file_hashes(folder)
    paths = (path.relative_to(folder).as_posix() for path in _listed(folder, set()))
    return sorted(path for path in paths if path not in covered or ending(path) in _COMPILED)


def frozen_copy(folder: Path, sha256: str, place: Path) -> Submission:
    """Copy what the hash of a submission covers into a new folder, and open the copy.

    Whatever else lies in the folder, or is put there later, is not in the copy.

    Raises:
        SubmissionError: if the copy has another hash, or cannot be opened.
    """
    copy = place / folder.name
    for name in file_hashes(folder):
        target = copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / name, target, follow_symlinks=False)
    submission = open_submission(str(copy))
    if submission.sha256 != sha256:
        raise SubmissionError(f"{folder} is not what was frozen, {sha256[:12]}")
    return submission


def with_seed(submission: Submission, seed: str, place: Path) -> Submission:
    """Copy a submission with the weights of one of its seeds in the place of its own."""
    copy = place / submission.folder.name
    shutil.copytree(submission.folder, copy, ignore=shutil.ignore_patterns(SEEDS))
    shutil.copytree(submission.folder / SEEDS / seed, copy, dirs_exist_ok=True)
    return open_submission(str(copy))


def _seed_problems(folder: Path) -> Iterator[Finding]:
    """Files of seeds that are no weights of the submission, and seeds that are too many."""
    advice = "put there only what another seed of the training changes"
    if len(seeds(folder)) > MAX_SEEDS:
        yield _problem(SEEDS, f"has more than {MAX_SEEDS} folders", advice)
    for path in _walk(folder / SEEDS):
        parts = path.relative_to(folder / SEEDS).parts
        stands_for = folder.joinpath(*parts[1:])
        if not (ending(path.name) in ARRAYS and stands_for.is_file() and len(parts) > 1):
            name = path.relative_to(folder).as_posix()
            message = "stands for no weights of the submission: seeds hold no code"
            yield _problem(name, message, advice)


def combined_hash(hashes: dict[str, str]) -> str:
    """SHA-256 of the names and contents of a submission's files, by the hash of each.

    Of the text that ``sha256sum`` prints for the files, sorted by relative path: ``HASH  PATH``.
    """
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(hashes.items()))
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


_README = "README.md"
_REQUIRED = {
    CONTROLLER: "write it with a class Controller; `ventbench new` shows one",
    MANIFEST: "write it; `ventbench new` shows one, submissions/README.md explains the keys",
    _README: "say in a few sentences what it does and how it was made",
}


def check_files(folder: Path) -> list[Finding]:
    """Look at every file of a submission's folder."""
    regular, findings = _inventory(folder, _listed(folder, _IGNORED_FOLDERS, hidden=True))
    for name, status in regular.items():
        findings += _file(folder / name, name, status)
    for first, second in collisions(regular):
        message = f"differs from {first} only in upper and lower case"
        findings.append(_problem(second, message, "rename one of them"))
    return findings + list(_required(folder))


def _inventory(
    folder: Path, paths: Iterable[Path]
) -> tuple[dict[str, os.stat_result], list[Finding]]:
    """Status of each regular file, by name; and what is wrong with their number, size and kinds."""
    findings: list[Finding] = []
    regular: dict[str, os.stat_result] = {}
    for path in paths:
        name, status = path.relative_to(folder).as_posix(), path.lstat()
        if len(regular) >= MAX_FILES:
            advice = "put what belongs together into one file"
            findings.append(_problem("the folder", f"has more than {MAX_FILES} files", advice))
            break
        if stat.S_ISREG(status.st_mode):
            regular[name] = status
        else:
            findings.append(_irregular(name, status.st_mode))
    findings += _size({name: status.st_size for name, status in regular.items()})
    return regular, [*findings, *_seed_problems(folder)]


def _problem(file: str, message: str, advice: str, *, problem: bool = True) -> Finding:
    return Finding("files", file, message, advice, problem=problem)


def _irregular(name: str, mode: int) -> Finding:
    if stat.S_ISLNK(mode):
        advice = "put the file itself there; nothing outside of the folder can be read anyway"
        return _problem(name, "is a symbolic link", advice)
    if stat.S_ISDIR(mode):
        hidden = Path(name).name.startswith(".")
        wrong = "is a hidden folder" if hidden else "lies in too many folders"
        return _problem(name, wrong, "move or remove it")
    return _problem(name, "is neither a file nor a folder", "remove it")


def _file(path: Path, name: str, status: os.stat_result) -> Iterator[Finding]:
    if path.name == ".DS_Store":
        advice = "leave it out of the pull request"
        yield _problem(name, "was written by macOS", advice, problem=False)
        return
    wrong, advice = path_problem(name), kind_problem(name)
    if wrong:
        rename = "rename or remove it: a pull request that holds it is refused"
        yield _problem(name, wrong, rename)
    elif advice:
        yield _problem(name, "is of a kind that is not accepted", advice)
    elif status.st_size <= MAX_BYTES:  # a larger one is a problem already
        yield from _content(path, name)
    if os.name != "nt" and status.st_mode & 0o111:
        refused = f"chmod -x {name}: a pull request with executables is refused"
        yield _problem(name, "is executable", refused, problem=False)


def _content(path: Path, name: str) -> Iterator[Finding]:
    try:
        content = path.read_bytes()
    except OSError as error:
        yield _problem(name, f"cannot be read: {error.strerror}", "make it readable")
        return
    if content.startswith(b"version https://git-lfs"):
        advice = "commit the file itself, without LFS"
        yield _problem(name, "is a pointer of git LFS, not the file", advice)
    elif ending(name) in ARRAYS:
        for message in weights_problems(path):
            yield _problem(name, message, WEIGHTS_ADVICE[ending(name)])
    elif ending(name) not in PICTURES:
        yield from _text(content, name)


def _text(content: bytes, name: str) -> Iterator[Finding]:
    try:
        clean = "\0" not in content.decode()
    except UnicodeDecodeError:
        clean = False
    if not clean and not name.endswith((".py", ".toml")):  # their own checks say so
        yield _problem(name, "is not UTF-8 text", "save it as UTF-8, or leave it out")


def _size(sizes: dict[str, int]) -> Iterator[Finding]:
    total = sum(sizes.values())
    if total > MAX_BYTES:
        largest = sorted(sizes, key=lambda name: -sizes[name])[:3]
        listed = ", ".join(f"{name} ({sizes[name] / 1e6:.1f} MB)" for name in largest)
        yield _problem(
            "the folder",
            f"has {total / 1e6:.1f} MB; at most {MAX_BYTES / 1e6:g} MB are accepted",
            f"the largest are {listed}; float32 or float16 weights take less",
        )


def _required(folder: Path) -> Iterator[Finding]:
    for name, advice in _REQUIRED.items():
        path = folder / name
        if not path.is_file():
            yield _problem(name, "is missing", advice)
        elif path.stat().st_size == 0:
            yield _problem(name, "is empty", advice)


#: Longest path below the submission's folder, characters, and how many names it may have.
MAX_PATH = 120
MAX_DEPTH = 6

_FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_WINDOWS = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)

#: Endings of text, weights and pictures: all others are refused.
TEXT, ARRAYS, PICTURES, _NAMES = (set(words.split()) for words in RULES["accepted"].values())
_COMPILED = RULES["compiled"].split()
_CODE = "compiled code is not reviewed and not run; submit the Python source"
_KIND_ADVICE = dict.fromkeys(_COMPILED, _CODE) | by_word(RULES["refused"])
_UNSUPPORTED_KIND = (
    "leave it out: only Python sources, text, pictures (.png, .jpg, .svg) "
    "and weights (.npz, .npy, .safetensors) are accepted"
)


def path_problem(path: str) -> str | None:
    """Say what is wrong with a path below the submission's folder, ``/`` between names.

    For a sentence that starts with the path; None if nothing is.
    """
    names = path.split("/")
    if len(path) > MAX_PATH or len(names) > MAX_DEPTH:
        return f"is longer than {MAX_PATH} characters or {MAX_DEPTH} names"
    for name in names:
        if name in ("", ".", ".."):
            return "is not a plain path"
        if name.startswith("."):
            return "is a hidden file or folder"
        if name == "__pycache__":
            return "is a cache that Python writes"
        if not name.isascii():
            return f"has other than ASCII characters in its name, {name!a}"
        if not _FILE_NAME.fullmatch(name):
            return "may have only letters, digits, '_', '-' and '.' in its name, '-' not first"
        if name.endswith(".") or _WINDOWS.fullmatch(name):
            return "has a name that some systems cannot store"
    return None


def ending(path: str) -> str:
    """Lower-case ending of a path's last name, such as ``".py"``; empty if there is none."""
    name = path.rpartition("/")[2]
    dot = name.rfind(".")
    return name[dot:].lower() if dot > 0 else ""


def kind_problem(path: str) -> str | None:
    """Return what to do about a file of a kind that is not accepted; None if it is accepted."""
    kind = ending(path)
    if kind in TEXT | ARRAYS | PICTURES or path.rpartition("/")[2] in _NAMES:
        return None
    return _KIND_ADVICE.get(kind, _UNSUPPORTED_KIND)


def collisions(paths: Iterable[str]) -> list[tuple[str, str]]:
    """Pairs of files or folders, by the paths of all files, that are one where case is ignored."""
    spellings: dict[str, str] = {}
    pairs = []
    for path in sorted(paths):
        names = path.split("/")
        for depth in range(1, len(names) + 1):
            part = "/".join(names[:depth])
            first = spellings.setdefault(part.casefold(), part)
            if first != part:
                pairs.append((first, part))
    return sorted(set(pairs))


#: Most bytes that the arrays of one file may take once they are unpacked.
MAX_UNPACKED = 100_000_000

_SAVE = "save it with numpy.savez(path, **arrays) of finite numbers"
#: What to do about weights, by ending.
WEIGHTS_ADVICE = {
    ".npz": _SAVE,
    ".npy": "save it with numpy.save(path, array) of finite numbers",
    ".safetensors": "save it with safetensors.numpy.save_file(arrays, path)",
}


def weights_problems(path: Path) -> list[str]:
    """Say what is wrong with a file of arrays, each for a sentence that starts with its name."""
    try:
        if path.suffix.lower() == ".safetensors":
            return _safetensors(path)
        if path.suffix.lower() == ".npz":
            return _npz(path)
        return _numbers({"it": np.load(path, mmap_mode="r", allow_pickle=False)})
    except Exception as error:  # whatever a hostile file brings numpy and zipfile to raise
        return [f"cannot be read without pickle: {type(error).__name__}: {error}"]


def _npz(path: Path) -> list[str]:
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
        names = archive.namelist()
    if unpacked > MAX_UNPACKED:
        limit = f"at most {MAX_UNPACKED / 1e6:g} MB are accepted"
        return [f"unpacks to {unpacked / 1e6:.0f} MB; {limit}"]
    if len(set(names)) < len(names):
        return ["holds two arrays of one name"]
    non_arrays = [name for name in names if not name.endswith(".npy")]
    if non_arrays:
        return [f"holds {non_arrays[0]!r}, which is no array"]
    with np.load(path, allow_pickle=False) as file:
        return _numbers({f"array {key!r}": file[key] for key in file.files})


def _numbers(arrays: Mapping[str, Any]) -> list[str]:
    problems = []
    for name, values in arrays.items():
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "biuf":
            problems.append(f"{name} does not hold numbers")
        elif not np.isfinite(values).all():
            problems.append(f"{name} holds NaN or infinity")
    return problems


def _safetensors(path: Path) -> list[str]:
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    if len(content) < 8 or size > len(content) - 8:
        return ["is not a safetensors file"]
    header = json.loads(content[8 : 8 + size])
    data, problems = content[8 + size :], []
    for name, descriptor in header.items():
        if name == "__metadata__":
            continue
        begin, end = descriptor["data_offsets"]
        kind, count = descriptor["dtype"], math.prod(descriptor["shape"])
        if not 0 <= begin <= end <= len(data):
            problems.append(f"array {name!r} lies outside of the file")
        elif kind in _FLOATS:
            values = np.frombuffer(data[begin:end], _FLOATS[kind])
            if len(values) != count:
                problems.append(f"array {name!r} does not have the size of its shape")
            elif not np.isfinite(values).all():
                problems.append(f"array {name!r} holds NaN or infinity")
    return problems


_FLOATS = {"F16": "<f2", "F32": "<f4", "F64": "<f8"}
