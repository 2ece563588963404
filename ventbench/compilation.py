"""Compiled functions are kept from one run to the next: those of a diagnosis take minutes."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path


def folder() -> Path:
    """Where they are kept: a folder of the user's cache for each kind of processor.

    ``VENTBENCH_CACHE`` names another one; empty for none.
    """
    chosen = os.environ.get("VENTBENCH_CACHE")
    if chosen is not None:
        return Path(chosen)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "ventbench" / "compiled" / _processor()


def keep() -> None:
    """Keep from here on what JAX compiles, and use what is kept; quietly without a folder."""
    if os.environ.get("VENTBENCH_CACHE") == "":
        return
    import jax

    try:
        place = folder()
        place.mkdir(parents=True, exist_ok=True)
    except OSError:  # a read-only home is no reason to fail
        return
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def _processor() -> str:
    """Name of the processor's instruction set: code of one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        flags = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:12]}"
