"""What an error is looked at along: phase, command, edges, pressure, flow, volume, time, lung."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.recordings.breaths import Breaths

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Width of the bins of time in a phase, s.
PHASE_STEP = 0.1

#: Ends of the bins of the command, %, and of the time since an edge, s.
OPENINGS = (0.0, 1.0, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0)
SINCE_EDGE = (0.0, 0.035, 0.07, 0.105, 0.15, 0.2, 0.3, 0.5, 1.0, 3.0)

#: A change of the command by more than this is an edge, % (percentage points).
EDGE = 5.0

#: About how many bins flow, volume and pressure get, and parts of the recording.
BINS, PARTS = 10, 5


@dataclass(frozen=True, eq=False)
class Axis:
    """k neighbouring ranges of one quantity, and the range that each sample lies in.

    Attributes:
        name: such as ``time since inspiration``.
        unit: of ``edges``.
        edges: ends of the ranges, ``(k + 1,)``.
        bins: range of each sample, -1 for none, ``(n, T)``.
        merge: whether neighbouring ranges may become one.
    """

    name: str
    unit: str
    edges: Floats
    bins: Integers
    merge: bool = True

    def __len__(self) -> int:
        """Number of ranges k."""
        return len(self.edges) - 1


def axes(
    breaths: Breaths, pressure: Floats, flow: Floats | None = None, volume: Floats | None = None
) -> tuple[Axis, ...]:
    """All axes of a recording.

    A sample belongs to the phase, command and edge that acted before it, since those made it.
    Pressure, flow and volume are the simulator's: sorted by the recorded ones, noise alone would
    have a mean error at either end.

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
    start, opened = (np.where(np.isfinite(x), x, np.nan) for x in (start, opened))
    u_in = before(breaths.u_in)
    found = [
        _phase("time since inspiration", breaths.time - start, acted & breaths.valid),
        _phase("time since expiration", breaths.time - opened, ~acted & breaths.valid),
        _axis("valve opening", "%", np.array(OPENINGS), u_in, acted),
        _axis("time since a valve edge", "s", np.array(SINCE_EDGE), since_edge(breaths)),
        _axis("pressure", "cmH2O", nice(pressure, breaths.valid), pressure),
    ]
    if flow is not None:
        found.append(_axis("flow", "mL/s", nice(flow, breaths.valid), flow))
    if volume is not None:
        found.append(_axis("volume", "mL", nice(volume, breaths.valid), volume))
    return (*found, *_parts(breaths), *_lungs(breaths))


def before(values: NDArray) -> NDArray:
    """What acted on each sample: the value of the one before; the first has its own, ``(n, T)``."""
    return np.concatenate([values[:, :1], values[:, :-1]], axis=1)


def since_edge(breaths: Breaths) -> Floats:
    """Time since either valve's last edge before each sample, s; NaN before any, ``(n, T)``."""
    u_in, u_out = breaths.u_in, np.asarray(breaths.u_out, float)
    edge = np.zeros(u_in.shape, bool)
    edge[:, 0] = u_in[:, 0] > EDGE  # a breath begins with the valve shut
    edge[:, 1:] = (np.abs(np.diff(u_in)) > EDGE) | (np.diff(u_out) != 0)
    at = np.maximum.accumulate(np.where(edge, breaths.time, -np.inf), axis=1)
    earlier = np.concatenate([np.full((len(at), 1), -np.inf), at[:, :-1]], axis=1)
    return np.where(np.isfinite(earlier), breaths.time - earlier, np.nan)


def nice(values: Floats, valid: NDArray[np.bool_]) -> Floats:
    """Ends of about :data:`BINS` ranges at round numbers that hold all but the outermost values."""
    inside = values[valid & np.isfinite(values)]
    if inside.size == 0:
        return np.array([0.0, 1.0])
    low, high = np.quantile(inside, [0.005, 0.995])
    wanted = max((high - low) / BINS, 1e-6)
    scale = 10.0 ** np.floor(np.log10(wanted))
    step = scale * next(x for x in (1.0, 2.0, 5.0, 10.0) if x * scale >= 0.999 * wanted)
    first, last = np.floor(low / step), max(np.ceil(high / step), np.floor(low / step) + 1)
    return np.round(step * np.arange(first, last + 1), 9)


def _axis(
    name: str, unit: str, edges: Floats, values: Floats, inside: NDArray[np.bool_] | bool = True
) -> Axis:
    """Sort values into ranges; what lies beyond the ends is in none."""
    # A sum of times is a hair off what it should be.
    bins = np.searchsorted(edges, values + 1e-9, side="right") - 1
    with np.errstate(invalid="ignore"):
        bins[np.abs(values - edges[-1]) < 1e-6] = len(edges) - 2
        within = inside & np.isfinite(values) & (bins >= 0) & (bins < len(edges) - 1)
    return Axis(name, unit, edges, np.where(within, bins, -1))


def _phase(name: str, time: Floats, inside: NDArray[np.bool_]) -> Axis:
    longest = np.max(time, initial=PHASE_STEP, where=inside & np.isfinite(time))
    edges = np.round(PHASE_STEP * np.arange(np.ceil(longest / PHASE_STEP - 1e-6) + 1), 6)
    return _axis(name, "s", edges, time, inside)


def _parts(breaths: Breaths) -> list[Axis]:
    """Fifths of the recording, by the number of the breath, from 1."""
    n, count = len(breaths), min(PARTS, len(breaths))
    cuts = np.round(np.linspace(0, n, count + 1))
    number = np.repeat(np.arange(n)[:, None], breaths.time.shape[1], axis=1)
    bins = np.where(breaths.valid, np.searchsorted(cuts, number, side="right") - 1, -1)
    return [Axis("breath number", "1", cuts, bins)] if count > 1 else []


def _lungs(breaths: Breaths) -> list[Axis]:
    """Each lung of several, over the whole breath."""
    if len(breaths.by_lung_index) < 2:
        return []
    end = float(np.max(breaths.time, initial=0.0, where=breaths.valid))
    found = []
    for name in breaths.by_lung_index:
        inside = (breaths.lung_ids == name)[:, None] & breaths.valid
        bins = np.where(inside, 0, -1)
        found.append(Axis(f"lung {name}", "s", np.array([0.0, end]), bins, merge=False))
    return found
