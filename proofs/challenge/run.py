"""Runs a diagnoser on one case: a process of its own, with limits of time and memory.

A diagnoser is a function of the case's folder that returns the answer. ``module:function`` is the
caller's own code and runs with his rights. A folder with a manifest, ``diagnoser.toml``, is a
stranger's: it is copied beside the case, and the process gives up files, network and rights before
its code is imported, as those of submissions do, where the system can.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ventbench.base.errors import InputError

#: Name of a manifest.
MANIFEST = "diagnoser.toml"

#: Diagnosers of the project, by name: ``module:function`` of each is in this package.
BUILT_IN = "proofs.diagnosers"

#: Seconds on the clock for each second of processor time, since other processes run too.
_PATIENCE = 10.0

#: Largest answer, bytes, and longest message of a process that failed.
_LARGEST, _LONGEST = 64_000_000, 300

#: Where the answer is written, so that prints do not mix with it.
_PIPE = 3

#: What a stranger finds imported, if his sources speak of it; all else is read from the disk.
_PRELOADED = ("numpy", "pandas", "scipy.linalg", "scipy.optimize", "jax.numpy")

_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "VENTBENCH_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
    "PYTHONHASHSEED": "0",
}


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of ``diagnoser.toml``."""

    name: str  #: shown on the board.
    function: str  #: ``file:function``, such as ``diagnose:diagnose`` for ``diagnose.py``.
    description: str = ""  #: a sentence.


@dataclass(frozen=True)
class Limits:
    """What a diagnoser may use on one case."""

    seconds: float = 300.0  #: processor time.
    memory: float = 16.0  #: address space, GiB.


@dataclass(frozen=True)
class Diagnoser:
    """A diagnoser."""

    name: str  #: letters, digits, ``_`` and ``-``; names the folder of its answers.
    function: str  #: ``module:function``.
    #: folder of a stranger's, which holds the module; None for the caller's own.
    folder: Path | None = None


@dataclass(frozen=True)
class Outcome:
    """What came of one run."""

    answer: bytes  #: bytes that the diagnoser gave; empty if there is a problem.
    problem: str  #: why there is no answer, or empty.
    seconds: float  #: processor time of the process.
    peak_mib: float  #: its largest memory.
    layers: tuple[str, ...]  #: what locked it down; empty for the caller's own code.


def find(given: str) -> Diagnoser:
    """Find a diagnoser.

    Args:
        given: ``module:function``, a folder with a manifest, or the name of a built-in one.

    Raises:
        InputError: if there is none, or its manifest is wrong.
    """
    path = Path(given)
    if ":" in given:
        return _named(given.replace(".", "_").replace(":", "-"), given, None)
    if given.isidentifier() and importlib.util.find_spec(f"{BUILT_IN}.{given}") is not None:
        return Diagnoser(given, f"{BUILT_IN}.{given}:diagnose")
    if path.is_dir():
        return _of_folder(path)
    raise InputError(
        f"there is no diagnoser {given!r}: give module:function, a folder with {MANIFEST}, or one "
        f"of {', '.join(built_in())}"
    )


def built_in() -> tuple[str, ...]:
    """Names of the built-in diagnosers."""
    places = importlib.import_module(BUILT_IN).__path__
    found = {path.stem for place in places for path in Path(place).glob("[a-z]*.py")}
    return tuple(sorted(found - {"common"}))


def _of_folder(folder: Path) -> Diagnoser:
    path = folder / MANIFEST
    if not path.is_file():
        raise InputError(f"{path} is missing; it needs name and function (file:function)")
    try:
        manifest = msgspec.convert(tomllib.loads(path.read_text("utf-8")), Manifest)
    except (ValueError, msgspec.ValidationError) as error:
        raise InputError(f"{path}: {error}") from error
    for link in (inside for inside in folder.rglob("*") if inside.is_symlink()):
        raise InputError(f"{link} is a link, which would be copied from elsewhere; send the file")
    if manifest.function.count(":") != 1:
        raise InputError(f"{path}: function is {manifest.function!r}; give file:function")
    return _named(manifest.name, manifest.function, folder.resolve())


def _named(name: str, function: str, folder: Path | None) -> Diagnoser:
    if not name.replace("_", "").replace("-", "").isalnum() or len(name) > 60:
        raise InputError(f"{name!r}: a name has letters, digits, _ and -, 60 at most")
    return Diagnoser(name, function, folder)


def run(diagnoser: Diagnoser, case: Path, limits: Limits) -> Outcome:
    """Run a diagnoser on the folder of a case, of which it gets a copy."""
    with tempfile.TemporaryDirectory() as place:
        given = Path(place) / "case"
        shutil.copytree(case, given)
        if diagnoser.folder is not None:
            shutil.copytree(diagnoser.folder, given / "diagnoser")
        given.chmod(0o755)
        Path(place).chmod(0o755)
        told = {
            "function": diagnoser.function,
            "case": os.path.realpath(given),
            "path": sys.path,
            "stranger": diagnoser.folder is not None,
            "preload": _preloaded(diagnoser.folder),
            "seconds": max(1, round(limits.seconds)),
            "memory": round(limits.memory * 2**30),
        }
        return _collect(told, limits)


def _preloaded(folder: Path | None) -> list[str]:
    if folder is None:
        return []
    text = b"".join(path.read_bytes() for path in sorted(folder.glob("**/*.py")))
    return [name for name in _PRELOADED if name.partition(".")[0].encode() in text]


def _collect(told: dict[str, Any], limits: Limits) -> Outcome:
    here, there = os.pipe()
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, **_ENVIRONMENT, "PYTHONPATH": root}
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", "from proofs.challenge.run import child; child()", str(there)],
            # A stranger may write no file, and nobody listens to what he prints.
            stdin=subprocess.PIPE,
            pass_fds=(there,),
            stderr=subprocess.STDOUT,
            stdout=subprocess.DEVNULL if told["stranger"] else errors,
            env=environment,
            start_new_session=True,
        )
        os.close(there)
        late = threading.Timer(_PATIENCE * limits.seconds, _end, (process.pid,))
        late.start()
        try:
            assert process.stdin is not None
            with process.stdin as pipe:
                pipe.write(json.dumps(told).encode())
            with os.fdopen(here, "rb") as pipe:
                data = pipe.read(_LARGEST + 1)
            if len(data) > _LARGEST:
                _end(process.pid)
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = code = os.waitstatus_to_exitcode(status)
        finally:
            late.cancel()
            _end(process.pid)  # and what it has started
        errors.seek(0)
        said = errors.read()[-100_000:].decode(errors="replace").strip()
    head, _, answer = data.partition(b"\n")
    told_back = json.loads(head) if head and not code else {"layers": [], "failure": ""}
    problem = told_back["failure"] or _problem(
        code, data, usage.ru_utime + usage.ru_stime, said, limits
    )
    peak = usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    return Outcome(
        b"" if problem else answer,
        problem,
        usage.ru_utime + usage.ru_stime,
        peak,
        tuple(told_back["layers"]),
    )


def _end(group: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def _problem(code: int, data: bytes, seconds: float, said: str, limits: Limits) -> str:
    if len(data) > _LARGEST:
        return f"the answer is longer than {_LARGEST} bytes"
    if code in (-9, -24) and seconds >= limits.seconds - 1.0:
        return f"took more than {limits.seconds:g} s of processor time"
    if code == -9:
        return f"was ended: more than {_PATIENCE * limits.seconds:g} s on the clock, or no memory"
    if code:
        last = said.rpartition("\n")[2][:_LONGEST]
        return f"ended by signal {-code}" if code < 0 else f"failed: {last or f'exit code {code}'}"
    return "" if data else "gave no answer"


def child() -> None:
    """Answer in the process of a diagnoser: lock down, import, call, write, end."""
    told = json.loads(sys.stdin.read())
    os.dup2(int(sys.argv[1]), _PIPE)
    for folder in told["path"]:
        if folder not in sys.path:
            sys.path.append(folder)
    layers, failure, data = [], "", b""
    try:
        layers = _lock_down(told)
        module, _, name = told["function"].partition(":")
        if told["stranger"]:
            sys.path.insert(0, f"{told['case']}/diagnoser")
        function: Callable[[Path], Any] = getattr(importlib.import_module(module), name)
        answer = function(Path(told["case"]))
        data = msgspec.json.encode(answer, enc_hook=_plain)
    except Exception as error:
        failure = f"{type(error).__name__}: {' '.join(str(error).split())}"
    head = msgspec.json.encode({"layers": layers, "failure": failure[:_LONGEST]})
    with os.fdopen(_PIPE, "wb") as pipe:
        pipe.write(head + b"\n" + data)
    os._exit(0)  # whatever threads are left


def _lock_down(told: dict[str, Any]) -> list[str]:
    from ventbench.sandbox.child import kernel
    from ventbench.sandbox.child.lockdown import FLOOR, CellLimits, Lockdown
    from ventbench.sandbox.reader import libraries

    if not told["stranger"]:
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (told["seconds"], told["seconds"] + 1))
        if (used := kernel.address_space()) is not None:
            size = used + told["memory"]
            resource.setrlimit(resource.RLIMIT_AS, (size, size))
        return []
    # Their libraries of the system cannot be opened afterwards.
    for module in told["preload"]:
        importlib.import_module(module)
    root = Path(__file__).resolve().parents[2]  # holds answers of others, too
    readable = [told["case"], *libraries(), str(root / "ventbench"), str(root / "data")]
    limits = CellLimits(told["memory"], told["seconds"], threads=True)
    layers = Lockdown(readable, [str(root)]).finish(limits, _PIPE + 1)
    lacking = [" or ".join(line) for line in FLOOR if not set(line) & set(layers)]
    if lacking:
        raise RuntimeError(f"{' and '.join(lacking)} missing here: a stranger's code does not run")
    return layers


def _plain(value: Any) -> Any:
    """Turn NumPy's arrays and numbers into plain values."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
