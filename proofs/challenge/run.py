"""Runs a diagnoser on one case: a process of its own, with limits of time and memory.

A diagnoser is a function of the case's folder that returns the answer. ``module:function`` is the
caller's own code and runs with his rights. A folder with a manifest, ``diagnoser.toml``, is a
stranger's: it is copied beside the case, and the process gives up files, network and rights before
its code is imported, as those of submissions do, where the system can. It has the environment of
submissions and none of the caller's, says which layers are in force before any of the stranger's
code is there, on a pipe that is then closed, and answers by one bounded message.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ventbench.base.errors import InputError
from ventbench.entries.folder import uncovered
from ventbench.entries.manifest import NAME, NAME_RULE
from ventbench.sandbox.child import kernel
from ventbench.sandbox.child.cell import printable
from ventbench.sandbox.child.lockdown import FLOOR, CellLimits, Lockdown
from ventbench.sandbox.reader import ENVIRONMENT as READER
from ventbench.sandbox.reader import libraries

#: Name of a manifest.
MANIFEST = "diagnoser.toml"

#: Diagnosers of the project, by name: ``module:function`` of each is in this package.
BUILT_IN = "proofs.diagnosers"

#: Seconds on the clock for each second of processor time, since other processes run too, and the
#: least.
_PATIENCE, _LEAST_S = 3.0, 60.0

#: Largest answer and report, bytes, and longest message of a process that failed.
_LARGEST, _REPORT, _LONGEST = 64_000_000, 10_000, 300

#: Descriptors of the report and of the answer, so that prints do not mix with them, and the byte
#: that an answer or the reason for none begins with.
_STATUS, _PIPE = 3, 4
_ANSWER, _FAILURE = b"+", b"-"

_SHORT_NAME = re.compile(r"[A-Za-z0-9_-]{1,60}")

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
        name = given.replace(".", "_").replace(":", "-")
        if not _SHORT_NAME.fullmatch(name):
            raise InputError(f"{name!r}: a name has letters, digits, _ and -, 60 at most")
        return Diagnoser(name, given)
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
    for strange in uncovered(folder):
        raise InputError(f"{folder / strange} is a link, a cache or compiled code; remove it")
    if not NAME.fullmatch(manifest.name):
        raise InputError(f"{path}: name {printable(manifest.name)} {NAME_RULE}")
    if manifest.function.count(":") != 1:
        raise InputError(f"{path}: function is {manifest.function!r}; give file:function")
    return Diagnoser(manifest.name, manifest.function, folder.resolve())


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
    root = str(Path(__file__).resolve().parents[2])
    given = READER if told["stranger"] else os.environ
    environment = {**given, **_ENVIRONMENT, "PYTHONPATH": root}
    clock_s = max(_LEAST_S, _PATIENCE * limits.seconds)
    reported, reports = os.pipe()
    here, there = os.pipe()
    boot = "from proofs.challenge.run import child; child()"
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-P", "-s", "-B", "-c", boot, str(reports), str(there)],
            # A stranger may write no file, and nobody listens to what he prints.
            stdin=subprocess.PIPE,
            pass_fds=(reports, there),
            stderr=subprocess.STDOUT,
            stdout=subprocess.DEVNULL if told["stranger"] else errors,
            env=environment,
            start_new_session=True,
        )
        os.close(reports)
        os.close(there)
        late = threading.Timer(clock_s, _end, (process.pid,))
        late.start()
        try:
            assert process.stdin is not None
            with process.stdin as pipe:
                pipe.write(json.dumps(told).encode())
            with os.fdopen(reported, "rb") as pipe:
                report = pipe.read(_REPORT)
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
    # Written by our own code alone, before that of a stranger is there.
    layers = tuple(json.loads(report)) if report else ()
    seconds = usage.ru_utime + usage.ru_stime
    kind, answer = data[:1], data[1:]
    problem = _problem(code, data, seconds, said, limits)
    if not problem and kind != _ANSWER:
        text = answer.decode(errors="replace") if kind == _FAILURE else "wrote what is no answer"
        problem = printable(" ".join(text.split()), _LONGEST)
    if not problem and told["stranger"] and (lacking := _lacking(layers)):
        problem = lacking
    peak = usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    return Outcome(b"" if problem else answer, problem, seconds, peak, layers)


def _lacking(layers: Sequence[str]) -> str:
    """Say which layers a stranger's code would need, of those in force; empty if none."""
    lacking = [" or ".join(line) for line in FLOOR if not set(line) & set(layers)]
    missing = " and ".join(lacking)
    return f"{missing} missing here: a stranger's code does not run" if missing else ""


def _end(group: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def _problem(code: int, data: bytes, seconds: float, said: str, limits: Limits) -> str:
    if len(data) > _LARGEST:
        return f"the answer is longer than {_LARGEST} bytes"
    if code in (-9, -24) and seconds >= limits.seconds - 1.0:
        return f"took more than {limits.seconds:g} s of processor time"
    if code == -9:
        clock_s = max(_LEAST_S, _PATIENCE * limits.seconds)
        return f"was ended: more than {clock_s:g} s on the clock, or no memory"
    if code:
        last = said.rpartition("\n")[2][:_LONGEST]
        return f"ended by signal {-code}" if code < 0 else f"failed: {last or f'exit code {code}'}"
    return "" if data else "gave no answer"


def child() -> None:
    """Answer in the process of a diagnoser: lock down, import, call, write, end."""
    told = json.loads(sys.stdin.read())
    high = [os.dup(fcntl.fcntl(int(given), fcntl.F_DUPFD, 32)) for given in sys.argv[1:]]
    for place, descriptor in zip((_STATUS, _PIPE), high, strict=True):
        os.dup2(descriptor, place)
    os.closerange(_PIPE + 1, 64)
    for folder in told["path"]:
        if folder not in sys.path:
            sys.path.append(folder)
    try:
        with os.fdopen(_STATUS, "wb") as report:
            report.write(json.dumps(_lock_down(told)).encode())
        module, _, name = told["function"].partition(":")
        if told["stranger"]:
            sys.path.insert(0, f"{told['case']}/diagnoser")
        function: Callable[[Path], Any] = getattr(importlib.import_module(module), name)
        answer = function(Path(told["case"]))
        data = _ANSWER + msgspec.json.encode(answer, enc_hook=_plain)
    except Exception as error:
        data = _FAILURE + f"{type(error).__name__}: {error}"[:_LONGEST].encode(errors="replace")
    with os.fdopen(_PIPE, "wb") as pipe:
        pipe.write(data)
    os._exit(0)  # whatever threads are left


def _lock_down(told: dict[str, Any]) -> list[str]:
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
    if lacking := _lacking(layers):
        raise RuntimeError(lacking)
    return layers


def _plain(value: Any) -> Any:
    """Turn NumPy's arrays and numbers into plain values."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
