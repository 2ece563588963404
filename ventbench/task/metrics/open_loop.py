"""Open-loop distance: how far a simulator strays under the same controls from the same start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats, Ints


def _differences(measured: ArrayLike, simulated: ArrayLike, mask: ArrayLike | None) -> Floats:
    """Absolute differences, NaN where they do not count; checks the shapes."""
    measured, simulated = np.asarray(measured, float), np.asarray(simulated, float)
    if measured.ndim == 0 or measured.shape != simulated.shape:
        raise ValueError(f"pressures of shapes {measured.shape} and {simulated.shape} do not pair")
    counts = np.broadcast_to(True if mask is None else np.asarray(mask, bool), measured.shape)
    counts = counts & ~np.isnan(measured)
    # The first sample is the common start, given and not predicted: T samples hold T - 1 steps.
    counts[..., 0] = False
    simulated = np.where(np.isnan(simulated), np.inf, simulated)
    return np.where(counts, np.abs(np.where(counts, measured, 0.0) - simulated), np.nan)


def _sum(differences: Floats) -> Floats:
    empty = np.all(np.isnan(differences), axis=-1)
    return np.where(empty, np.nan, np.nansum(differences, axis=-1))


def distance(measured: ArrayLike, simulated: ArrayLike, mask: ArrayLike | None = None) -> Floats:
    """Open-loop distance of each breath, the paper's equation for one sequence of controls.

    ``sum over t = 1..T of |f1(x_t1, u_t) - f2(x_t2, u_t)|``: both systems start from the same
    pressure, get the same controls, and their answers are compared after each control. The
    expectation over controls is the mean over breaths, see :mod:`ventbench.task.metrics.bootstrap`.

    Args:
        measured: recorded pressure, cmH2O, shape ``(..., T + 1)``; the first sample is the common
            start and is never counted. NaN marks a missing sample, which is not counted either.
        simulated: pressure of the simulator at the same samples, cmH2O, same shape.
        mask: samples that count (such as the inspiratory ones), broadcast against ``measured``.

    Returns:
        Sum over counted steps, cmH2O, shape ``(...)``; NaN for a breath in which none counts, and
        infinite for one in which the simulator itself gave NaN or infinity at a counted sample.

    Raises:
        ValueError: if the shapes do not pair.
    """
    return _sum(_differences(measured, simulated, mask))


def mae(measured: ArrayLike, simulated: ArrayLike, mask: ArrayLike | None = None) -> Floats:
    """Mean absolute error per step of each breath, cmH2O: :func:`distance` over the counted steps.

    Arguments as of that; NaN where no step counts.
    """
    differences = _differences(measured, simulated, mask)
    steps = np.sum(~np.isnan(differences), axis=-1)
    return _sum(differences) / np.where(steps, steps, 1)


def by_horizon(measured: ArrayLike, simulated: ArrayLike, mask: ArrayLike | None = None) -> Floats:
    """Mean absolute error at each step after the start, over breaths (the paper's figure).

    Arguments as of :func:`distance`, ``(n, T + 1)``. Returns the mean over the breaths that count a
    step, cmH2O, shape ``(T,)``; NaN where none does.
    """
    differences = _differences(measured, simulated, mask)[:, 1:]
    counted = np.sum(~np.isnan(differences), axis=0)
    total = np.nansum(differences, axis=0)
    return np.where(counted, total / np.where(counted, counted, 1), np.nan)


#: Edges of the ranges in which recorded commands are counted, %; 100 belongs to the last range.
EDGES = tuple(float(edge) for edge in range(0, 101, 10))

#: Ranges with fewer recorded samples than this are sparse.
SPARSE_BELOW = 20

#: Command above which the valve of the recordings is hardly known, %.
WIDE_OPEN = 70.0


@dataclass(frozen=True)
class Extrapolation:
    """Commands of an entry on one lung, and the recordings of it."""

    wide_open: float  #: share of commands at or above :data:`WIDE_OPEN`, 0..1.
    #: share of commands in ranges with fewer than :data:`SPARSE_BELOW` recorded samples.
    sparse: float
    recorded_wide_open: int  #: recorded samples of the lung at or above :data:`WIDE_OPEN`.
    recorded: int  #: all its recorded samples.


def command_counts(u_in: ArrayLike) -> Ints:
    """Count commands, %, of any shape in the ranges of :data:`EDGES`; shape ``(10,)``."""
    return np.histogram(np.asarray(u_in, float), bins=EDGES)[0].astype(np.int64)


def extrapolation(u_in: ArrayLike, recorded: ArrayLike) -> Extrapolation:
    """Compare commands on one lung, %, with :func:`command_counts` of its recordings, ``(10,)``."""
    commands, counts = np.asarray(u_in, float), np.asarray(recorded, np.int64)
    used = command_counts(commands)
    wide = np.asarray(EDGES[:-1]) >= WIDE_OPEN
    return Extrapolation(
        wide_open=float(np.mean(commands >= WIDE_OPEN)),
        sparse=float(used[counts < SPARSE_BELOW].sum() / max(used.sum(), 1)),
        recorded_wide_open=int(counts[wide].sum()),
        recorded=int(counts.sum()),
    )


def by_lung(
    u_in: Mapping[str, ArrayLike], lungs: Mapping[str, Mapping[str, Any]]
) -> dict[str, Extrapolation]:
    """Compare commands, %, by lung id, with what ``ventbench.plants.frozen.Frozen.lungs`` says."""
    return {
        name: extrapolation(commands, lungs[name]["recorded_commands"])
        for name, commands in u_in.items()
    }
