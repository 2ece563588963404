"""Quantities along which errors are analysed: phase, command, pressure and others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.recordings.breaths import Breaths

#: Share of the extreme values at either end that the ranges of a quantity need not hold.
_EXTREME = 0.005

#: Width of the ranges of time in a phase, s; about how many ranges flow, volume and pressure are
#: divided into; parts that the recording is divided into.
_PHASE_STEP, _RANGES, _COUNT = 0.1, 10, 5

#: Ends of the ranges of the inspiratory valve's command, %, and of the time since an edge, s.
_OPENINGS = np.array(
    [0.0, 1.0, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0]
)
_EDGE_TIMES = np.array([0.0, 0.035, 0.07, 0.105, 0.15, 0.2, 0.3, 0.5, 1.0, 3.0])

#: Change of the inspiratory valve's command that is an edge, percentage points.
EDGE_SIZE = 5.0

#: Axis of the time since a valve's edge.
EDGE = "time since a valve edge"


@dataclass(frozen=True, eq=False)
class Axis:
    """k neighbouring ranges of one quantity, and the range in which each sample lies."""

    name: str  #: name of the quantity, such as ``time since inspiration``.
    unit: str  #: unit of ``edges``.
    edges: Floats  #: ends of the ranges, ``(k + 1,)``.
    bins: Ints  #: index of the range of each sample, -1 for none, ``(n, T)``.
    merge: bool = True  #: whether neighbouring ranges may be merged.

    def __len__(self) -> int:
        """Number of ranges k."""
        return len(self.edges) - 1


def axes(
    breaths: Breaths, pressure: Floats, flow: Floats | None = None, volume: Floats | None = None
) -> tuple[Axis, ...]:
    """All axes of a recording.

    A sample is assigned to the phase, command and edge that acted before it, because these caused
    it. Pressure, flow and volume are those of the simulator: sorted by the recorded values, noise
    alone would have a mean error in the outermost ranges.

    Args:
        breaths: n breaths of T samples.
        pressure: simulated, cmH2O, ``(n, T)``.
        flow: simulated, into the lung, mL/s, ``(n, T)``.
        volume: simulated, mL, ``(n, T)``.
    """
    acted = before(np.asarray(breaths.u_out)) == 0
    start = np.where(acted & breaths.valid, breaths.time, np.inf).min(axis=1, keepdims=True)
    # The first sample of expiration is still the end of inspiration.
    opened = np.where(
        (breaths.u_out == 1) & (breaths.time >= start) & breaths.valid, breaths.time, np.inf
    ).min(axis=1, keepdims=True)
    # A breath without the phase has no time in it.
    start, opened = (np.where(np.isfinite(time), time, np.nan) for time in (start, opened))
    u_in = before(breaths.u_in)

    def edges(values: Floats) -> Floats:
        return round_edges(values, breaths.valid)

    all_axes = [
        _phase("time since inspiration", breaths.time - start, acted & breaths.valid),
        _phase("time since expiration", breaths.time - opened, ~acted & breaths.valid),
        _axis("valve opening", "%", _OPENINGS, u_in, acted),
        _axis(EDGE, "s", _EDGE_TIMES, since_edge(breaths)),
        _axis("pressure", "cmH2O", edges(pressure), pressure),
    ]
    if flow is not None:
        all_axes.append(_axis("flow", "mL/s", edges(flow), flow))
    if volume is not None:
        all_axes.append(_axis("volume", "mL", edges(volume), volume))
    return (*all_axes, *_parts(breaths), *_lungs(breaths))


def before(values: NDArray) -> NDArray:
    """Value that acted on each sample: that of the sample before, ``(n, T)``.

    The first sample has its own value.
    """
    return np.concatenate([values[:, :1], values[:, :-1]], axis=1)


def since_edge(breaths: Breaths) -> Floats:
    """Time since either valve's last edge before each sample, s; NaN before any, ``(n, T)``."""
    u_in, u_out = breaths.u_in, np.asarray(breaths.u_out, float)
    is_edge = np.zeros(u_in.shape, bool)
    is_edge[:, 0] = u_in[:, 0] > EDGE_SIZE  # a breath begins with the valve shut
    is_edge[:, 1:] = (np.abs(np.diff(u_in)) > EDGE_SIZE) | (np.diff(u_out) != 0)
    at = np.maximum.accumulate(np.where(is_edge, breaths.time, -np.inf), axis=1)
    earlier = np.concatenate([np.full((len(at), 1), -np.inf), at[:, :-1]], axis=1)
    return np.where(np.isfinite(earlier), breaths.time - earlier, np.nan)


def round_edges(values: Floats, valid: Bools) -> Floats:
    """Ends of about ten ranges at round numbers, without the most extreme values."""
    inside = values[valid & np.isfinite(values)]
    if inside.size == 0:
        return np.array([0.0, 1.0])
    low, high = np.quantile(inside, [_EXTREME, 1.0 - _EXTREME])
    wanted = max((high - low) / _RANGES, 1e-6)
    scale = 10.0 ** np.floor(np.log10(wanted))
    step = scale * next(x for x in (1.0, 2.0, 5.0, 10.0) if x * scale >= 0.999 * wanted)
    first, last = np.floor(low / step), max(np.ceil(high / step), np.floor(low / step) + 1)
    return np.round(step * np.arange(first, last + 1), 9)


def _axis(name: str, unit: str, edges: Floats, values: Floats, inside: Bools | bool = True) -> Axis:
    """Sort values into ranges; a value beyond the ends is in none."""
    # Sums of times carry rounding errors.
    bins = np.searchsorted(edges, values + 1e-9, side="right") - 1
    with np.errstate(invalid="ignore"):
        bins[np.abs(values - edges[-1]) < 1e-6] = len(edges) - 2
        within = inside & np.isfinite(values) & (bins >= 0) & (bins < len(edges) - 1)
    return Axis(name, unit, edges, np.where(within, bins, -1))


def _phase(name: str, time: Floats, inside: Bools) -> Axis:
    step = _PHASE_STEP
    longest = np.max(time, initial=step, where=inside & np.isfinite(time))
    edges = np.round(step * np.arange(np.ceil(longest / step - 1e-6) + 1), 6)
    return _axis(name, "s", edges, time, inside)


def _parts(breaths: Breaths) -> list[Axis]:
    """Parts of the recording by the number of the breath."""
    n, count = len(breaths), min(_COUNT, len(breaths))
    cuts = np.round(np.linspace(0, n, count + 1))
    number = np.repeat(np.arange(n)[:, None], breaths.time.shape[1], axis=1)
    bins = np.where(breaths.valid, np.searchsorted(cuts, number, side="right") - 1, -1)
    return [Axis("breath number", "1", cuts, bins)] if count > 1 else []


def _lungs(breaths: Breaths) -> list[Axis]:
    """One axis for each lung if there are several, over the whole breath."""
    if len(breaths.by_lung_index) < 2:
        return []
    end = float(np.max(breaths.time, initial=0.0, where=breaths.valid))
    lungs = []
    for name in breaths.by_lung_index:
        inside = (breaths.lung_ids == name)[:, None] & breaths.valid
        bins = np.where(inside, 0, -1)
        lungs.append(Axis(f"lung {name}", "s", np.array([0.0, end]), bins, merge=False))
    return lungs
