"""Hostile files are read in a child process with little memory, little time and no rights.

Parsers are not made for hostile input: a regular expression may take hours, a deeply nested
expression overflows the stack, a small archive unpacks to gigabytes. In the child that costs an
entry its chance and the scorer nothing. The zygote starts its interpreter with the same options.
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
from pathlib import Path
from typing import Any

import numpy as np

from ventbench.sandbox.child.lockdown import OUT_OF_MEMORY, TOO_DEEP

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
    cpu_s: int = CPU_S,
) -> Any:
    """Call a function on a hostile folder in a limited process without rights.

    Args:
        function: ``"module:name"``; it is given ``str(folder)`` and the arguments.
        folder: all that it may read, besides Python and installed packages.
        arguments: JSON values.
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
        "memory": MEMORY,
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
            raise UnreadableError(_why(code, cpu_s, stderr.read(100_000)))
    return json.loads(answer)


def _why(code: int, cpu_s: int, message: bytes) -> str:
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"takes more than {cpu_s} s of processor time to be read"
    if code == OUT_OF_MEMORY:
        return f"takes more than {MEMORY >> 20} MiB of memory to be read"
    if code == TOO_DEEP:
        return "is nested too deeply to be read"
    if code < 0:
        return f"cannot be read: the parser was ended by signal {-code}"
    last = message.decode(errors="replace").strip().rpartition("\n")[2]
    return f"cannot be read: {last[:200] or f'exit code {code}'}"
