"""What the elements of slots share: coefficients, and a shape that can be drawn."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench.physics.mechanism import Mechanism, Values
from ventbench.physics.parameters import Parameter

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Shape:
    """A curve to be drawn.

    Attributes:
        x: what it depends on, ``(k,)``.
        y: the curve, ``(k,)``.
        x_unit: name and unit, such as ``volume, mL``.
        y_unit: likewise.
        absorbed: powers of ``x`` that base parameters could take over.
    """

    x: Floats
    y: Floats
    x_unit: str
    y_unit: str
    absorbed: tuple[int, ...] = ()


class Element(Mechanism):
    """Base of the elements: their coefficients are their parameters."""

    def coefficients(self, values: Values) -> list[Array]:
        """All parameters in order."""
        return [values[item.name] for item in self.description.parameters]

    def stacked(self, values: Values, state: Array) -> Array:
        """Coefficients beside several states ``(K, ...)``, in their shape."""
        own = self.coefficients(values)[: len(state)]
        return jnp.stack([jnp.broadcast_to(c, state.shape[1:]) for c in own])

    def weight(self, values: Values) -> float:
        """How strong it is: its largest coefficient, in standard deviations before any data."""
        items = self.description.parameters
        return max(abs(float(values[p.name])) / (p.spread or 1.0) for p in items)

    def fading(self, values: Values, taus: tuple[float, ...], time: Floats) -> Floats:
        """Sum of the coefficients, each fading with its time constant, at ``time``."""
        rates = np.exp(-time[:, None] / np.asarray(taus))
        return rates @ np.array([float(c) for c in self.coefficients(values)[: len(taus)]])

    def shapes(self, values: Values, base: Mapping[str, float]) -> tuple[Shape, ...]:
        """Curves to be drawn, given own and base parameters."""
        raise NotImplementedError


def coefficients(
    at: Iterable[str], unit: str, meaning: str, low: float | Iterable[float],
    high: float | Iterable[float], spread: float | Iterable[float], *,
    follows: str | None = None, scan: tuple[float, ...] = (),
) -> tuple[Parameter, ...]:  # fmt: skip
    """Parameters ``c1``, ``c2`` and so on, which start at zero and tend to it.

    Args:
        at: where each acts, in words.
        unit: of all.
        meaning: of all; ``at`` is put behind.
        low: bounds, one for all or one for each.
        high: likewise.
        spread: standard deviation before any data, likewise.
        follows: ``"R"`` or ``"C"`` if they scale with it.
        scan: values that a search must also try.
    """
    at = list(at)

    def each(x: float | Iterable[float]) -> list[float]:
        return [float(x)] * len(at) if isinstance(x, int | float) else [float(v) for v in x]

    rows = zip(at, each(low), each(high), each(spread), strict=True)
    return tuple(
        Parameter(
            f"c{k}", unit, f"{meaning} {place}", bottom, top, 0.0, 0.0, 0.5 * width,
            follows=follows, scan=scan, spread=width,
        )
        for k, (place, bottom, top, width) in enumerate(rows, 1)
    )  # fmt: skip
