"""The population of rigs of each lung, from which rigs are drawn that nobody has trained on.

A rig is a vector of unconstrained numbers, so that whatever is drawn is a rig: resistances,
elastance, delays, lags and slopes are positive, the valve's curve is monotone, the elastic curve
rises, and the plays' weights add up to less than one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.plants.hybrid import ELASTIC_KNOTS, PLAYS, VALVE_KNOTS, Hybrid
from ventbench.task.draws import uniforms

#: Command at which the flow of a valve is its size, %.
SIZE_AT = 20.0

#: Flow at which a resistance is compared, L/s.
FLOW = 0.5

#: The plays' weights add up to less than this.
DIRECTION_SUM = 0.98

#: Significant digits of a drawn rig: fewer than those in which mathematical libraries differ.
DIGITS = 6

_LOGARITHMS = (
    "valve_delay", "valve_lag", "circuit_compliance", "sensor_lag", "rising", "falling",
    "conductance", "closing_conductance", "opening_delay", "closing_delay", "closing_lag", "rest",
)  # fmt: skip

#: What the lung decides: resistance at :data:`FLOW`, share of its quadratic part, elastance, offset
#: and elastic curve. All other numbers are the ventilator's.
LUNG = (
    *("resistance", "turbulence", "elastance", "offset"),
    *(f"stiffening_{k}" for k in range(len(ELASTIC_KNOTS))),
)

#: Names of the numbers of a rig, in order.
NAMES = (
    *LUNG,
    "valve_size",
    *(f"valve_bend_{k}" for k in range(1, len(VALVE_KNOTS))),
    *(f"direction_{k}" for k in range(len(PLAYS))),
    *_LOGARITHMS,
)

_KNOTS, _PLAYS, _BENDS = len(ELASTIC_KNOTS), len(PLAYS), len(VALVE_KNOTS) - 1
_WIDTHS = np.clip(SIZE_AT - np.array(VALVE_KNOTS), 0.0, np.diff(np.append(VALVE_KNOTS, np.inf)))


def to_vector(plant: Hybrid) -> Floats:
    """Numbers of rigs.

    Args:
        plant: leaves ``(...)``, with a closing lag.

    Returns:
        Shape ``(..., len(NAMES))``, in the order of :data:`NAMES`: logarithms, but for the offset
        (cmH2O), the change of the logarithmic slope at each elastic knot and from each segment of
        the valve's curve to the next, and the logarithmic odds of the plays' weights.
    """
    leaf = {name: np.asarray(value, float) for name, value in vars(plant).items()}
    slope = 1.0 + np.cumsum(leaf["stiffening"], axis=-1)
    weight = -leaf["direction"]
    odds = weight / (DIRECTION_SUM - weight.sum(axis=-1, keepdims=True))
    columns = [
        np.log(leaf["R"] + FLOW * leaf["K2"]),
        np.log(FLOW * leaf["K2"] / leaf["R"]),
        np.log(leaf["E"]),
        leaf["offset"],
        *np.moveaxis(np.diff(np.log(slope), axis=-1, prepend=0.0), -1, 0),
        np.log(leaf["slopes"] @ _WIDTHS),
        *np.moveaxis(np.diff(np.log(leaf["slopes"]), axis=-1), -1, 0),
        *np.moveaxis(np.log(odds), -1, 0),
        *(np.log(leaf[name]) for name in _LOGARITHMS),
    ]
    return np.stack(columns, axis=-1)


def from_vector(vector: Any, xp: Any = jnp) -> Hybrid:
    """Rigs of numbers: the inverse of :func:`to_vector`.

    Args:
        vector: shape ``(..., len(NAMES))``.
        xp: ``jax.numpy``, which can be differentiated, or ``numpy``.
    """
    resistance, turbulence, elastance, offset = (vector[..., k] for k in range(4))
    at = 4
    slope = xp.exp(xp.cumsum(vector[..., at : at + _KNOTS], axis=-1))
    at += _KNOTS
    size, bends = vector[..., at], vector[..., at + 1 : at + 1 + _BENDS]
    at += 1 + _BENDS
    shape = xp.exp(
        xp.concatenate([xp.zeros_like(bends[..., :1]), xp.cumsum(bends, axis=-1)], axis=-1)
    )
    odds = xp.exp(vector[..., at : at + _PLAYS])
    at += _PLAYS
    laminar = xp.exp(resistance) / (1.0 + xp.exp(turbulence))
    return Hybrid(
        R=laminar, K2=laminar * xp.exp(turbulence) / FLOW, E=xp.exp(elastance),
        stiffening=xp.diff(slope, axis=-1, prepend=xp.ones_like(slope[..., :1])), offset=offset,
        slopes=shape * (xp.exp(size) / (shape * _WIDTHS).sum(axis=-1))[..., None],
        direction=-DIRECTION_SUM * odds / (1.0 + odds.sum(axis=-1, keepdims=True)),
        **{name: xp.exp(vector[..., at + k]) for k, name in enumerate(_LOGARITHMS)},
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RigPopulation:
    """Populations of the rigs of L lungs."""

    mean: Floats  #: shape ``(L, p)``.
    factor: Floats  #: lower triangular factor of the covariance of a new rig, shape ``(L, p, p)``.

    def rigs(self, seed: bytes, lung: int, count: int) -> Hybrid:
        """Draw rigs of a lung, by its index and a seed of 32 bytes; the same everywhere.

        Numpy leaves ``(count, ...)`` of :data:`DIGITS` significant digits; more begin alike.
        """
        numbers = uniforms(seed, f"population 1, lung {lung}", (count, len(NAMES)))
        normal = np.round(np.vectorize(NormalDist().inv_cdf, otypes=[float])(numbers), 4)
        vector = self.mean[lung] + (self.factor[lung] @ normal[..., None])[..., 0]
        drawn = from_vector(vector, np)
        return jax.tree.map(_rounded, drawn)


def _rounded(value: Floats) -> Floats:
    """Round to :data:`DIGITS` significant digits."""
    exponent = np.floor(np.log10(np.maximum(np.abs(value), 1e-300))).astype(int)
    scale = 10.0 ** np.abs(DIGITS - 1 - exponent)
    up = exponent <= DIGITS - 1
    return np.where(up, np.round(value * scale) / scale, np.round(value / scale) * scale)


def save(population: RigPopulation, path: Path) -> None:
    """Write a population in one step."""
    arrays: dict[str, Any] = {name: np.round(x, 8) for name, x in vars(population).items()}
    files.write_atomically(path, lambda file: np.savez(file, **arrays))


def load(path: Path) -> RigPopulation:
    """Read what :func:`save` wrote.

    Raises:
        InputError: if it is missing or is no population of such rigs.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            found = RigPopulation(arrays["mean"], arrays["factor"])
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path} is not a population of rigs: {error}") from error
    if found.mean.shape[1:] != (len(NAMES),):
        raise InputError(f"{path} holds rigs of {found.mean.shape[1:]} numbers, not {len(NAMES)}")
    return found
