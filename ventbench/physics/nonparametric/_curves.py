"""Curves of one variable that are linear in their coefficients, cheap to evaluate and to derive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import jax
import jax.numpy as jnp
from jax import Array

Number = Array | float


@dataclass(frozen=True)
class Hats:
    """Straight lines from knot to knot, and constant beyond the first and the last.

    Attributes:
        knots: rising.
    """

    knots: tuple[float, ...]

    def __call__(self, x: Array, at: Sequence[Number]) -> Array:
        """Value at ``x``, given those at the knots."""
        value = at[0] + 0.0 * x
        for j, (a, b) in _pairs(self.knots):
            value = value + (at[j + 1] - at[j]) / (b - a) * _within(x, a, b)
        return value

    def slope(self, x: Array, at: Sequence[Number]) -> Array:
        """Derivative by ``x``."""
        slope = 0.0 * x
        for j, (a, b) in _pairs(self.knots):
            slope = slope + (at[j + 1] - at[j]) / (b - a) * ((x > a) & (x <= b))
        return slope


@dataclass(frozen=True)
class Integral:
    """A smooth curve through zero whose slope is a straight line from knot to knot.

    Beyond the last knot it goes on straight, and so it does below the first, which is zero.

    Attributes:
        knots: rising, from 0.
    """

    knots: tuple[float, ...]

    def __call__(self, x: Array, slopes: Sequence[Number]) -> tuple[Array, Array]:
        """Value and slope at ``x``, given the slopes at the knots."""
        value, slope = slopes[0] * x, slopes[0] + jnp.zeros_like(x)
        for j, (a, b) in _pairs(self.knots):
            bend, inside = (slopes[j + 1] - slopes[j]) / (b - a), _within(x, a, b)
            slope = slope + bend * inside
            value = value + bend * inside * (x - a - 0.5 * inside)
        return value, slope


def _pairs(knots: tuple[float, ...]) -> list[tuple[int, tuple[float, float]]]:
    return list(enumerate(pairwise(knots)))


def _within(x: Array, low: float, high: float) -> Array:
    """How far ``x`` lies beyond ``low``, at most up to ``high``."""
    bottom, top = jnp.asarray(low, x.dtype), jnp.asarray(high, x.dtype)
    return jax.lax.clamp(bottom, x, top) - bottom


def beside(constants: tuple[float, ...], state: Array) -> Array:
    """One constant for each of several states ``(K, ...)``."""
    return jnp.asarray(constants, state.dtype).reshape(-1, *[1] * (state.ndim - 1))
