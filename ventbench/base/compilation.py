"""How JAX compiles: precision, functions kept from one run to the next, memory handed back.

Scores are float64; training and grids may be float32. No global switch is ever flipped.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
from contextlib import AbstractContextManager
from functools import lru_cache
from pathlib import Path

#: JAX's name of the time that compiling took, and seconds from which it leaves much memory behind.
_COMPILED, _LONG = "/jax/core/compile/backend_compile_duration", 0.5

#: Option of glibc's ``mallopt``: the most pools of memory.
_ARENA_MAX = -8


def float64() -> AbstractContextManager[None]:
    """Context in which new JAX arrays and traces are 64-bit.

    Functions jitted by ventbench may be called inside and outside: JAX keeps one compilation for
    each.
    """
    import jax

    return jax.enable_x64(True)


def float32() -> AbstractContextManager[None]:
    """Context in which new JAX arrays and traces are 32-bit, which is JAX's default."""
    import jax

    return jax.enable_x64(False)


def folder() -> Path:
    """Folder of kept functions: in the user's cache, one for each kind of processor.

    ``VENTBENCH_CACHE`` names another one; empty for none.
    """
    chosen = os.environ.get("VENTBENCH_CACHE")
    if chosen is not None:
        return Path(chosen)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "ventbench" / "compiled" / _processor()


def keep() -> None:
    """Keep from here on what JAX compiles, and use what is kept; quietly without a folder.

    A folder that was chosen before, by JAX's own setting, stays.
    """
    _hand_back()
    if os.environ.get("VENTBENCH_CACHE") == "":
        return
    import jax

    chosen = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if chosen is not None and "VENTBENCH_CACHE" not in os.environ:
        return
    try:
        place = folder()
        place.mkdir(parents=True, exist_ok=True)
    except OSError:  # a read-only home is no reason to fail
        return
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


def one_blas_thread() -> AbstractContextManager[object]:
    """Context in which each call of linear algebra takes one thread.

    Matrices of a fit are small: more threads wait for each other, which on a busy machine takes
    several times the processor time that the products do.
    """
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1, user_api="blas")


def is_warm() -> bool:
    """Whether functions compiled by an earlier run are kept."""
    if os.environ.get("VENTBENCH_CACHE") == "":
        return False
    place = folder()
    return place.is_dir() and any(place.iterdir())


@lru_cache(maxsize=1)
def _hand_back() -> None:
    """Hand memory back to the system after each compilation: a third of all that a diagnosis takes.

    The C library keeps what the compiler has freed, about 100 MiB a time, in up to eight pools for
    each core. Only the one of GNU can be told otherwise.
    """
    try:
        libc = ctypes.CDLL(None)
        limit, trim = libc.mallopt, libc.malloc_trim
    except (AttributeError, OSError, TypeError):
        return
    limit(_ARENA_MAX, 2)
    from jax import monitoring

    def compiled(event: str, duration_secs: float, **_: object) -> None:
        if event == _COMPILED and duration_secs > _LONG:
            trim(0)

    monitoring.register_event_duration_secs_listener(compiled)


def _processor() -> str:
    """Name of the processor's instruction set: code of one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        flags = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:12]}"
