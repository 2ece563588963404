"""How much of what a controller commands lies beyond what was recorded of a lung.

A simulator is learned from the commands of the recordings. Where there are few of them it follows
its prior, and a score there is worth less.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Edges of the ranges in which recorded commands are counted, %; 100 belongs to the last range.
EDGES = tuple(float(edge) for edge in range(0, 101, 10))

#: Ranges with fewer recorded samples than this are sparse.
SPARSE_BELOW = 20

#: Command above which the valve of the recordings is hardly known, %.
WIDE_OPEN = 70.0


@dataclass(frozen=True)
class Extrapolation:
    """Commands of an entry on one lung, and the recordings of it.

    Attributes:
        wide_open: share of commands at or above :data:`WIDE_OPEN`, 0..1.
        sparse: share of commands in ranges with fewer than :data:`SPARSE_BELOW` recorded samples.
        recorded_wide_open: recorded samples of the lung at or above :data:`WIDE_OPEN`.
        recorded: all its recorded samples.
    """

    wide_open: float
    sparse: float
    recorded_wide_open: int
    recorded: int


def command_counts(u_in: ArrayLike) -> NDArray[np.int64]:
    """Count commands, %, of any shape in the ranges of :data:`EDGES`; shape ``(10,)``."""
    return np.histogram(np.asarray(u_in, float), bins=EDGES)[0].astype(np.int64)


def extrapolation(u_in: ArrayLike, recorded: ArrayLike) -> Extrapolation:
    """Compare commands on one lung with the recordings of it.

    Args:
        u_in: commands as applied, %, any shape.
        recorded: :func:`command_counts` of the recordings, shape ``(10,)``.
    """
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
    """Compare commands with the recordings, lung by lung.

    Args:
        u_in: commands of each lung, %, by lung id.
        lungs: what :meth:`ventbench.plants.frozen.Frozen.lungs` of version 2 gives.
    """
    return {
        name: extrapolation(commands, lungs[name]["recorded_commands"])
        for name, commands in u_in.items()
    }
