"""Hostile files are read in a child process with little memory, little time and no rights.

Parsers are not made for hostile input: a regular expression may take hours, a deeply nested
expression overflows the stack, a small archive unpacks to gigabytes. In the child that costs an
entry its chance and the scorer nothing. The zygote starts its interpreter with the same options;
what it is told of a submission, and what that may use, stands here too.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ventbench.base.errors import InputError
from ventbench.sandbox.child.cell import SubmissionError
from ventbench.sandbox.child.lockdown import OUT_OF_MEMORY, TOO_DEEP
from ventbench.sandbox.child.zygote import NUMPY

#: The folder that holds ``ventbench``, and the one of installed packages.
ROOT = str(Path(__file__).resolve().parents[2])
SITE = str(Path(np.__file__).resolve().parents[1])

#: Not -I, which would make it ignore the fixed hash seed: the environment holds nothing but this.
OPTIONS = ("-P", "-s", "-S", "-B")
ENVIRONMENT = {
    "PYTHONHASHSEED": "0",
    "LC_ALL": "C.UTF-8",
    "TZ": "UTC",
    "HOME": "/nonexistent",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
}


#: Bytes of address space beyond the interpreter's: weights unpack to at most 100 MB.
MEMORY = 1 << 30
#: Seconds of processor time. The largest folder that is accepted takes about 2.
CPU_S = 20
#: Seconds on the clock; the child never waits, so only a very busy machine takes so long.
PATIENCE_S = 600.0
#: Largest answer, bytes.
ANSWER = 4_000_000

_BOOT = (
    "import sys; sys.path.insert(0, sys.argv[2]); from ventbench.sandbox.child import lockdown; "
    "lockdown.read(sys.argv[1])"
)


def libraries() -> list[str]:
    """Folders on the search path that belong to Python, and none that ``PYTHONPATH`` adds."""
    ours = [Path(prefix).resolve() for prefix in (sys.prefix, sys.base_prefix)]
    folders = [Path(path).resolve() for path in sys.path if os.path.isdir(path)]
    return [str(x) for x in folders if any(x.is_relative_to(prefix) for prefix in ours)]


class UnreadableError(Exception):
    """Files that cannot be read within the limits; the text continues "the submission ..."."""


def read_apart(
    function: str,
    folder: Path,
    arguments: Sequence[Any] = (),
    *,
    memory: int = MEMORY,
    cpu_s: int = CPU_S,
) -> Any:
    """Call a function on a hostile folder in a limited process without rights.

    Args:
        function: ``"module:name"``; it is given ``str(folder)`` and the arguments.
        folder: all that it may read, besides Python and installed packages.
        arguments: JSON values.
        memory: bytes of address space beyond the interpreter's.
        cpu_s: seconds of processor time.

    Returns:
        What the function returned, as it comes back from JSON.

    Raises:
        UnreadableError: if the process ran out of something, or was ended.
    """
    real = os.path.realpath(folder)
    request = {
        "function": function,
        "arguments": [real, *arguments],
        "readable": [real, ROOT, SITE, *libraries()],
        "site": SITE,
        "memory": memory,
        "cpu_s": cpu_s,
    }
    with (
        tempfile.TemporaryFile() as stderr,
        subprocess.Popen(
            [sys.executable, *OPTIONS, "-c", _BOOT, json.dumps(request), ROOT],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            cwd="/",
            env=ENVIRONMENT,
            start_new_session=True,
        ) as process,
    ):
        assert process.stdout is not None
        patience = threading.Timer(PATIENCE_S, process.kill)
        patience.start()
        try:
            answer = process.stdout.read(ANSWER + 1)
            if len(answer) > ANSWER:
                process.kill()
                raise UnreadableError("has more wrong with it than can be listed")
            code = process.wait()
        finally:
            patience.cancel()
            process.kill()
        if code:
            stderr.seek(0)
            raise UnreadableError(_why(code, memory, cpu_s, stderr.read(100_000)))
    return json.loads(answer)


def _why(code: int, memory: int, cpu_s: int, said: bytes) -> str:
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"takes more than {cpu_s} s of processor time to be read"
    if code == OUT_OF_MEMORY:
        return f"takes more than {memory >> 20} MiB of memory to be read"
    if code == TOO_DEEP:
        return "is nested too deeply to be read"
    if code < 0:
        return f"cannot be read: the parser was ended by signal {-code}"
    last = said.decode(errors="replace").strip().rpartition("\n")[2]
    return f"cannot be read: {last[:200] or f'exit code {code}'}"


class SandboxError(InputError):
    """This machine cannot run submissions apart as was asked for; the message says what to do."""


MIB, GIB = 1 << 20, 1 << 30


@dataclass(frozen=True)
class Allowance:
    """Limits of a session; the processor is shared by all its cells, hence patience, not a pace."""

    memory: int = 512 * MIB  #: bytes of one cell beyond the interpreter with its libraries.
    cpu_s: int = 60  #: seconds of processor time of one cell: import, reset and three breaths.
    start_patience_s: float = 20.0  #: processor time in which a controller is imported and reset.
    #: processor time of one answer. Cells that wait for something, or for a processor, time out
    #: when none of them has answered for a multiple of it on the clock.
    patience_s: float = 5.0
    #: all cells time out when a session has taken this long on the clock, so that no entry keeps
    #: others waiting for longer.
    total_s: float = 900.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"allowance {name} is {value}, it must be positive")


#: Packages that may be imported besides numpy and the standard library, with what to load of each.
OPTIONAL = {
    "jax": ("jax", "jax.numpy", "jax.scipy", "jax.scipy.linalg"),
    "flax": ("flax", "flax.linen", "flax.nnx"),
    "safetensors": ("safetensors", "safetensors.numpy"),
}

#: Those that start threads and reserve much address space.
_THREADED = ("jax", "flax")


def modules_needed(folder: Path) -> tuple[tuple[str, ...], bool]:
    """Modules to load before cells start, so that they share them, and whether they need threads.

    Raises:
        SubmissionError: if the sources cannot be read within the limits.
    """
    try:
        packages = read_apart("ventbench.sandbox.child.sources:imported_packages", folder)
    except UnreadableError as error:
        raise SubmissionError(f"{folder.name}: a source {error}") from None
    imported = [name for name in OPTIONAL if name in packages]
    modules = [module for name in imported for module in OPTIONAL[name]]
    return (*NUMPY, *modules), any(name in _THREADED for name in imported)


#: JAX reserves address space that it does not use.
_THREADED_MEMORY = 4 * GIB


def configuration(folder: str, label: str, allowance: Allowance) -> dict[str, object]:
    """What a zygote is told of a submission: folder, name in messages, and what cells may use."""
    modules, threads = modules_needed(Path(folder))
    memory = max(allowance.memory, _THREADED_MEMORY) if threads else allowance.memory
    return {
        "folder": folder,
        "label": label,
        "packages": modules,
        "limits": {"memory": memory, "cpu_s": allowance.cpu_s, "threads": threads},
    }
