"""bubblewrap around the zygote where it is installed: a file system with nothing else in it."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence

from ventbench.sandbox.child.zygote import RANDOM

_SYSTEM = ("/lib", "/lib64", "/usr/lib", "/usr/lib64", "/etc/ld.so.cache")


def prefix(folders: Sequence[str]) -> list[str]:
    """Words to put before the zygote's command; none where bubblewrap is missing or may not run.

    Args:
        folders: that the zygote and its cells read, besides the interpreter.
    """
    program = shutil.which("bwrap")
    if program is None or sys.platform != "linux":
        return []
    words = [program, *_options(folders), "--"]
    return words if _works((*words, sys.executable, "-I", "-S", "-c", "")) else []


def _options(folders: Sequence[str]) -> list[str]:
    interpreter = (
        *(sys.prefix, sys.base_prefix, sysconfig.get_path("stdlib")),
        *(os.path.dirname(path) for path in (sys.executable, os.path.realpath(sys.executable))),
    )
    options = ["--unshare-all", "--die-with-parent", "--as-pid-1", "--cap-drop", "ALL"]
    for path in (*_SYSTEM, *interpreter, *folders):
        options += ["--ro-bind-try", path, path]
    for device in ("/dev/null", RANDOM):
        options += ["--dev-bind", device, device]
    # The zygote reads there how much memory it has; its cells cannot.
    return [*options, "--proc", "/proc", "--chdir", "/"]


@functools.cache
def _works(command: tuple[str, ...]) -> bool:
    try:
        run = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=10, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return run.returncode == 0
