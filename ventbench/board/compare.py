"""A record against what its commands give when they are replayed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ventbench.board.record import Record
from ventbench.board.replayed import Replayed

#: How far a replayed number may be off, cmH2O; matrix products round differently elsewhere.
TOLERANCE = 1e-9

# What is rounded to 0.01 cmH2O or 0.1 %: half of that, and a little for ties.
_CENTI, _TENTH = 0.005 + 1e-6, 0.05 + 1e-6


def deviation(record: Record, found: Replayed) -> float:
    """Largest difference of an error, cmH2O; infinity where one of them does not exist."""
    pairs = ((record.nominal, found.nominal), (record.drawn, found.drawn))
    return max(float(np.max(_off(*pair), initial=0.0)) for pair in pairs)


def differences(record: Record, found: Replayed) -> list[str]:
    """What differs, by key of the record; empty if the record is what its commands give.

    Args:
        record: as it was written.
        found: replayed from its commands.
    """
    content, clipped = record.content, record.content["clipped"]
    size = int(np.prod(content["actions"]["shape"]))
    checks: tuple[tuple[str, ArrayLike, ArrayLike, float], ...] = (
        ("errors.nominal", record.nominal, found.nominal, TOLERANCE),
        ("errors.drawn", record.drawn, found.drawn, TOLERANCE),
        ("spread", record.spread, found.spread, TOLERANCE),
        ("safe", content["safe"], found.safe, 0.0),
        (
            "peak_pressure_cmH2O",
            content["peak_pressure_cmH2O"],
            found.peak.max(axis=(0, 2)),
            TOLERANCE,
        ),
        ("safety.peak_centi_cmH2O", record.peak, found.peak, _CENTI),
        ("safety.steps_above", record.steps_above, found.steps_above, 0.0),
        ("clipped.below", clipped["below"], found.below, 0.0),
        ("clipped.above", clipped["above"], found.above, 0.0),
        ("clipped.commands", clipped["commands"], size, 0.0),
        ("trace.pressure_centi_cmH2O", record.pressure, found.pressure, _CENTI),
        ("trace.u_in_tenths_percent", record.u_in, found.u_in, _TENTH),
    )
    return [text for check in checks if (text := _difference(*check)) is not None]


def _difference(key: str, recorded: ArrayLike, found: ArrayLike, most: float) -> str | None:
    """Describe the worst value of a key, if it is off by more than that."""
    recorded, found = np.asarray(recorded, float), np.asarray(found, float)
    if recorded.shape != found.shape:
        return f"key {key} has shape {recorded.shape}, its commands give {found.shape}"
    off = _off(recorded, found)
    if off.size == 0 or np.all(off <= most):
        return None
    index: Any = np.unravel_index(int(np.argmax(off)), off.shape)
    place = "".join(f"[{i}]" for i in index)
    return f"key {key}{place} says {recorded[index]:.12g}, its commands give {found[index]:.12g}"


def _off(recorded: ArrayLike, found: ArrayLike) -> np.ndarray:
    """Differences; 0 in failed cells, whose commands nobody gave, infinity where one is missing."""
    recorded, found = np.asarray(recorded, float), np.asarray(found, float)
    off = np.nan_to_num(np.abs(recorded - found), nan=np.inf)
    return np.where(np.isnan(recorded), 0.0, off)
