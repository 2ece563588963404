"""Scores are float64; training and grids may be float32. No global switch is ever flipped."""

from __future__ import annotations

from contextlib import AbstractContextManager

import jax


def float64() -> AbstractContextManager[None]:
    """Context in which new JAX arrays and traces are 64-bit.

    Functions jitted by ventbench may be called inside and outside: JAX keeps one compilation for
    each.
    """
    return jax.enable_x64(True)


def float32() -> AbstractContextManager[None]:
    """Context in which new JAX arrays and traces are 32-bit, which is JAX's default."""
    return jax.enable_x64(False)
