"""Where breaths begin and end in a continuous recording, and when the expiratory valve is open."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Columns, Floats, Ints
from ventbench.base.errors import InputError

#: Shortest breath, s, and longest.
_SHORTEST, _LONGEST = 0.5, 30.0

#: Share of the range of flow or pressure that an inspiration exceeds.
_ONSET = 0.1

#: Share of the largest flow below which none flows, and of all flow that may not come back.
_RESTS, _UNBALANCED = 0.02, 0.1

#: A gap in time of more than so many intervals ends a breath.
_GAP = 5.0

#: Fewest readings of a breath that a trigger recorded, and fewest such breaths.
_FEWEST, _PIECES = 10, 4


def find_breaths(
    file: str,
    time: Floats,
    values: Columns,
    keys: list[Ints],
    groups: list[Ints],
    lead: float,
) -> tuple[list[Ints], str]:
    """Split a continuous recording where inspirations begin.

    Args:
        file: names the recording in messages.
        time: times, s, shape ``(N,)``; NaN where there is none.
        values: columns by role, in the units of the schema, ``(N,)`` each.
        keys: columns a change of which begins a breath.
        groups: those of them that only tell recordings apart.
        lead: time before the number of a breath changes at which its samples begin, s.

    Returns:
        Rows of each whole breath, and a sentence that says how they were found.

    Raises:
        InputError: if no whole breath is found.
    """
    rows = np.arange(len(time))
    broken = np.zeros(len(time), bool)
    broken[0] = True
    for key in groups:
        broken[1:] |= np.diff(key) != 0
    steps = np.diff(time, prepend=time[0])
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    starts = broken.copy()
    numbered = len(keys) > len(groups)
    if numbered:
        for key in keys:
            starts[1:] |= np.diff(key) != 0
        if lead and usual:
            at = np.flatnonzero(starts & ~broken) - round(lead / usual)
            starts = broken.copy()
            starts[at[at > 0]] = True
        how = "by the column that numbers them"
    else:
        gaps = (steps < 0) | (steps > _GAP * max(usual, 1e-9))
        broken[1:] |= gaps[1:]
        onsets, how = _onsets(file, time, values)
        starts = broken.copy()
        starts[onsets] = True
        if _are_breaths(np.split(values["pressure"], np.flatnonzero(broken)[1:])):
            starts, numbered, how = broken, True, "where the clock leaves a gap"
    pieces = np.split(rows, np.flatnonzero(starts)[1:])
    complete, short, timeless = [], 0, 0
    for k, piece in enumerate(pieces):
        at = time[piece][np.isfinite(time[piece])]
        if len(at) < 2 <= len(piece):
            timeless += 1
            continue
        length = at[-1] - at[0] if len(at) > 1 else 0.0
        # The first and the last piece of a split recording are no whole breaths.
        edge = not numbered and (
            piece[0] not in onsets or k + 1 == len(pieces) or bool(broken[pieces[k + 1][0]])
        )
        if edge or not _SHORTEST <= length <= _LONGEST:
            short += 1
            continue
        complete.append(piece)
    if not complete:
        raise InputError(
            f"{file}: no whole breath was found {how}; a breath lasts {_SHORTEST:g} to "
            f"{_LONGEST:g} s. Check the rate and the units, or map a column that numbers breaths "
            "with --map NAME=breath"
        )
    omitted = f"; {short} pieces that are no whole breath were left out" if short else ""
    if timeless:
        omitted += f"; {timeless} without times were left out"
    return complete, f"{len(complete)} breaths, split {how}{omitted}."


def _are_breaths(pieces: list[Floats]) -> bool:
    """Whether a trigger recorded each breath by itself, as four fifths of them show.

    Pressure begins and ends in the lower half of its range, and crosses that once each way.
    """

    def is_breath(pressure: Floats) -> bool:
        known = pressure[np.isfinite(pressure)]
        if len(known) < _FEWEST:
            return False
        smooth = np.convolve(known, np.full(3, 1.0 / 3.0), "valid")
        above = smooth > 0.5 * (smooth.min() + smooth.max())
        return not above[0] and not above[-1] and np.count_nonzero(np.diff(above)) == 2

    return len(pieces) >= _PIECES and bool(np.mean([is_breath(p) for p in pieces]) >= 0.8)


def expiratory_valve(values: Columns, pieces: list[Ints]) -> tuple[NDArray[np.int8], str]:
    """Return u_out of each row, ``(N,)``, and a sentence that says where it is from.

    Args:
        values: columns by role, in the units of the schema, ``(N,)`` each.
        pieces: rows of each breath.
    """
    if "u_out" in values:
        return (values["u_out"] > 0.5).astype(np.int8), "u_out is that of the file."
    if "target" in values:
        u_out = (~_is_high(values["target"])).astype(np.int8)
        return u_out, "u_out is 1 where the target is low."
    u_out = np.zeros(len(values["pressure"]), np.int8)
    if "flow" in values:
        flow = _bridged(values["flow"])
        limit = -_RESTS * float(np.quantile(np.abs(flow), 0.99))
        for piece in pieces:
            inward = flow[piece] > -limit
            after = np.maximum.accumulate(inward) | ~inward.any()
            u_out[piece] = np.maximum.accumulate(after & (flow[piece] < limit))
        return u_out, "u_out is 1 from where flow turns outwards."
    pressure = _bridged(values["pressure"])
    for piece in pieces:
        p = pressure[piece]
        peak = int(np.argmax(p))
        fallen = p < 0.5 * (p[peak] + p[-1])
        fallen[:peak] = False
        u_out[piece] = np.maximum.accumulate(fallen)
    return u_out, "u_out is 1 from where pressure has fallen half-way from its peak (a guess)."


def _onsets(file: str, time: Floats, values: Columns) -> tuple[Ints, str]:
    """Rows at which inspirations begin, and what shows them."""
    if "u_out" in values:
        shut = values["u_out"] < 0.5
        return _rises(shut), "where the expiratory valve closes"
    if "target" in values:
        return _rises(_is_high(values["target"])), "where the target rises"
    if "u_in" in values and np.nanmax(values["u_in"]) > 0:
        on = np.nan_to_num(values["u_in"]) > 0
        openings = _after_pause(on, time)
        return openings, "where the inspiratory valve opens"
    if "flow" in values and np.isfinite(values["flow"]).any():
        flow = _bridged(values["flow"])
        size = float(np.quantile(np.abs(flow), 0.99))
        return _crossings(flow, _ONSET * size, 0.3 * _ONSET * size), "where flow turns inwards"
    pressure = _bridged(values["pressure"])
    low, high = np.quantile(pressure, [0.1, 0.98])
    if high - low < 1.0:
        raise InputError(
            f"{file}: pressure spans {high - low:.2g} cmH2O, in which no breath can be seen"
        )
    rise = pressure - low
    span = high - low
    return _crossings(rise, 0.3 * span, _ONSET * span), "where pressure rises"


def signed_flow(file: str, time: Floats, pressure: Floats, flow: Floats) -> Floats | None:
    """Flow that was recorded without its sign, mL/s, with it, ``(N,)``; None of any other flow.

    Such a flow is never negative. It turns outwards where it is least between the peak of the
    pressure and its fall; as much goes out as came in then, which no one-way flow does.
    """
    pressure, signed = _bridged(pressure), _bridged(flow).copy()
    if np.quantile(signed, 0.01) < -_RESTS * np.quantile(signed, 0.99):
        return None
    onsets, _ = _onsets(file, time, {"pressure": pressure})
    for start, end in pairwise(sorted({0, *onsets.tolist(), len(time)})):
        p, q = pressure[start:end], signed[start:end]
        peak = np.argmax(p)
        fallen = np.argmax(p[peak:] < np.quantile(p, _ONSET) + _ONSET * np.ptp(p))
        q[peak + np.argmin(q[peak : peak + fallen + 1]) :] *= -1.0
    is_balanced = abs(signed.sum()) < _UNBALANCED * np.abs(signed).sum()
    return np.where(np.isfinite(flow), signed, np.nan) if is_balanced else None


def _crossings(signal: Floats, high: float, low: float) -> Ints:
    """Rows before which a signal was low for the last time before it becomes high."""
    at = np.flatnonzero((signal <= low) | (signal >= high))
    is_low = signal[at] <= low
    return at[:-1][is_low[:-1] & ~is_low[1:]]


def _rises(on: Bools) -> Ints:
    """Rows at which something is on that was not in the row before."""
    return np.flatnonzero(on[1:] & ~on[:-1]) + 1


def _after_pause(on: Bools, time: Floats) -> Ints:
    """Rows at which a valve opens after it was shut for a while."""
    shuts = np.flatnonzero(~on & np.append(True, on[:-1]))
    opens = _rises(on)
    return opens[time[opens] - time[shuts[: len(opens)]] >= 0.2]


def _is_high(signal: Floats) -> Bools:
    """Whether a signal of two levels is at the upper one."""
    return signal > 0.5 * (np.nanmin(signal) + np.nanmax(signal))


def _bridged(values: Floats) -> Floats:
    """Values with their blanks interpolated, shape ``(N,)``."""
    finite = np.isfinite(values)
    if finite.all():
        return values
    return np.interp(np.arange(len(values)), np.flatnonzero(finite), values[finite])
