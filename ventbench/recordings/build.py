"""Making `Breaths` from arrays, whose lengths may differ."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ventbench.recordings.breaths import Breaths

FILL = {"u_in": 0.0, "u_out": 1, "pressure": np.nan, "flow": np.nan, "volume": np.nan}
"""What stands in padding."""


def stack(values: np.ndarray, lengths: np.ndarray, fill: float) -> np.ndarray:
    """Put breaths that follow one another into rows.

    Args:
        values: samples of all breaths, (m,).
        lengths: samples of each breath, (n,), summing to m.
        fill: what stands after a short breath.

    Returns:
        An array (n, T) of the same type, T the longest length; a view if all are equal.
    """
    width = int(lengths.max(initial=0))
    if (lengths == width).all():
        return values.reshape(len(lengths), width)
    rows, columns = _places(lengths)
    out = np.full((len(lengths), width), fill, dtype=values.dtype)
    out[rows, columns] = values
    return out


def stack_times(time: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and intervals; in padding, time goes on at the last interval.

    Args:
        time: s, (m,).
        lengths: samples of each breath, at least 2, (n,).

    Returns:
        time and dt, s, each (n, T).
    """
    padded = stack(time, lengths, np.nan)
    if (lengths != padded.shape[1]).any():
        every = np.arange(len(lengths))
        last = padded[every, lengths - 1]
        step = last - padded[every, lengths - 2]
        beyond = np.arange(padded.shape[1]) - (lengths - 1)[:, None]
        padded = np.where(beyond > 0, last[:, None] + beyond * step[:, None], padded)
    dt = np.empty_like(padded)
    np.subtract(padded[:, 1:], padded[:, :-1], out=dt[:, :-1])
    dt[:, -1] = dt[:, -2]
    return padded, dt


def valid_mask(lengths: np.ndarray) -> np.ndarray:
    """True for samples, False for padding, (n, T)."""
    return np.arange(int(lengths.max(initial=0))) < lengths[:, None]


def make_breaths(
    breath_id: ArrayLike,
    R: ArrayLike,
    C: ArrayLike,
    time: ArrayLike,
    u_in: ArrayLike,
    u_out: ArrayLike,
    pressure: ArrayLike,
    *,
    flow: ArrayLike | None = None,
    volume: ArrayLike | None = None,
) -> Breaths:
    """Make breaths of equal length from arrays, for instance from a simulation.

    Args:
        breath_id: whole numbers, each once, (n,).
        R: cmH2O/(L/s), (n,).
        C: mL/cmH2O, (n,).
        time: s, increasing in each breath and starting at 0, (n, T).
        u_in: %, (n, T).
        u_out: 0 or 1, (n, T).
        pressure: cmH2O, (n, T).
        flow: mL/s, (n, T), or None.
        volume: mL, (n, T), or None.

    Returns:
        The breaths, copied, all valid.

    Raises:
        ValueError: shapes do not fit, an id is there twice, or time does not start at 0 and
            increase.
    """
    ids = np.array(breath_id, dtype=np.int64)
    times = np.array(time, dtype=np.float64)
    if times.ndim != 2 or times.shape[1] < 2:
        raise ValueError(f"time has shape {times.shape}, but (n, T) with T >= 2 is needed")
    if len(np.unique(ids)) != len(ids):
        raise ValueError("breath_id holds the same id twice; give each breath its own")
    if (times[:, 0] != 0.0).any() or not (np.diff(times, axis=1) > 0.0).all():
        raise ValueError("time must start at 0 in each breath and increase")
    per_breath = {"R": np.array(R, np.float64), "C": np.array(C, np.float64), "breath_id": ids}
    samples = {
        "u_in": np.array(u_in, np.float64),
        "u_out": np.array(u_out, np.int8),
        "pressure": np.array(pressure, np.float64),
        "flow": None if flow is None else np.array(flow, np.float64),
        "volume": None if volume is None else np.array(volume, np.float64),
    }
    for name, array in (per_breath | samples).items():
        shape = times.shape if name in samples else times.shape[:1]
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, but {shape} is needed")
    lengths = np.full(len(ids), times.shape[1])
    times, dt = stack_times(times.ravel(), lengths)
    return Breaths(
        **per_breath,
        **samples,  # type: ignore[arg-type]
        time=times,
        dt=dt,
        valid=valid_mask(lengths),
        time_inferred=np.zeros(len(ids), dtype=bool),
    )


def _places(lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum(lengths) - lengths
    rows = np.repeat(np.arange(len(lengths)), lengths)
    return rows, np.arange(len(rows)) - np.repeat(starts, lengths)
