"""What a record says about where it was made: versions, lock file, machine."""

from __future__ import annotations

import os
import platform
import re
from importlib import metadata
from pathlib import Path
from typing import Any

import ventbench
from ventbench import files

_PACKAGES = ("flax", "jax", "jaxlib", "numpy", "safetensors", "scipy")

#: Instruction sets that decide how matrix products round, as /proc/cpuinfo names them, widest last.
_ISA = ("asimd", "sve", "sve2", "sse4_2", "avx", "avx2", "fma", "avx512f")


def versions() -> dict[str, str]:
    """Versions of Python and packages, and the hash of the lock file where there is one."""
    found = {"ventbench": ventbench.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    lock = Path(ventbench.__file__).resolve().parent.parent / "requirements.lock"
    if lock.is_file():
        found["requirements.lock"] = files.sha256(lock)
    return found


def machine() -> dict[str, Any]:
    """What the scorer ran on: system, kernel, processor and its instruction sets."""
    info = _cpuinfo()
    flags = set(info.get("flags", info.get("Features", "")).split())
    limit = re.search(r"--xla_cpu_max_isa=(\w+)", os.environ.get("XLA_FLAGS", ""))
    return {
        "system": _system(),
        "kernel": f"{platform.system()} {platform.release()}",
        "architecture": platform.machine(),
        "cpu": info.get("model name", platform.processor()),
        "isa": [name for name in _ISA if name in flags],
        "isa_limit": limit[1] if limit else None,
        "cores": os.cpu_count() or 0,
    }


def _system() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        return f"{platform.system()} {platform.release()}"


def _cpuinfo() -> dict[str, str]:
    """First processor of /proc/cpuinfo; empty where there is none."""
    path = Path("/proc/cpuinfo")
    found: dict[str, str] = {}
    if path.is_file():
        for line in path.read_text(errors="replace").splitlines():
            key, _, value = line.partition(":")
            found.setdefault(key.strip(), value.strip())
    return found
