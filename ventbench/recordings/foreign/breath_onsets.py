"""Layouts known by name, and where inspirations begin: at a number, valve, flow or pressure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError

#: What a column may stand for.
ROLES = (
    "time", "pressure", "flow", "volume", "u_in", "u_out", "R", "C", "breath", "group", "target",
    "unused",
)  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """Columns of a known kind of file."""

    name: str  #: name on the command line.
    about: str  #: what writes such files.
    columns: dict[str, str]  #: role of each column.
    #: units by role, where they are not those of the schema.
    units: dict[str, str] = field(default_factory=dict)
    required: tuple[str, ...] = ()  #: columns by which a file is recognised.
    lead: float = 0.0  #: time before the number of a breath changes at which its samples begin, s.


LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout(
            "kaggle",
            "the public data of the Google Brain competition, which is ventbench's own schema",
            {
                "time_step": "time", "breath_id": "breath", "R": "R", "C": "C", "u_in": "u_in",
                "u_out": "u_out", "pressure": "pressure", "flow": "flow", "volume": "volume",
            },
            required=("breath_id", "R", "C", "time_step", "u_in", "u_out"),
        ),
        Layout(
            "respiraworks",
            "RespiraWorks test data as one table, a run and a test a recording; its valve commands "
            "are those of another ventilator and are left out",
            {
                "time_step": "time", "run": "group", "test": "group", "breath": "breath", "R": "R",
                "C": "C", "pressure": "pressure", "flow": "flow", "volume": "volume",
                "target": "target",
            },
            required=("run", "test", "breath", "cmd_inh_valve"),
            lead=0.25,
        ),
        Layout(
            "pvp",
            "logs of the People's Ventilator Project (`waveforms` of log2csv or log2mat); the flow "
            "out of the patient is no flow into the lung and is left out",
            {
                "timestamp": "time", "pressure": "pressure", "control_in": "u_in",
                "control_out": "u_out", "cycle_number": "breath",
            },
            required=("timestamp", "pressure", "control_in", "control_out", "cycle_number"),
        ),
        Layout(
            "servo",
            "what a Servo ventilator exports as text, [REC] in the first line, in any language; "
            "inspirations are the phases in which more flows in than out",
            {
                "time": "time", "pressure": "pressure", "flow": "flow", "volume": "volume",
                "expiration": "u_out",
            },
            required=("time", "pressure", "flow", "expiration"),
        ),
    )
}  # fmt: skip

_NAMES: dict[str, str] = {
    "time": "time timestep timestamp t zeit tempo temps tiempo clock datetime elapsed elapsedtime "
    "relativetime seconds",
    "pressure": "pressure paw airwaypressure p pao pvent pmouth pcircuit druck pressione pression "
    "presion",
    "flow": "flow flowrate airflow q vdot fluss flusso debit flujo",
    "volume": "volume vol v volumen",
    "u_in": "uin", "u_out": "uout", "R": "r", "C": "c",
    "breath": "breath breathid cyclenumber breathnumber",
}  # fmt: skip

#: Roles of columns that are understood without a map, by the stem of their names.
USUAL: dict[str, str] = {name: role for role, names in _NAMES.items() for name in names.split()}


def recognise(names: tuple[str, ...]) -> Layout | None:
    """Return the layout whose required columns a file has, or None."""
    for layout in LAYOUTS.values():
        if set(layout.required) <= set(names):
            return layout
    return None


#: Shortest breath, s, and longest.
_SHORTEST, _LONGEST = 0.5, 30.0

#: Share of the range of flow or pressure that an inspiration exceeds.
_ONSET = 0.1

#: A gap in time of more than so many intervals ends a breath.
_GAP = 5.0


def find_breaths(
    file: str, time: Floats, values: Mapping[str, Floats], other: Mapping[str, Floats],
    keys: list[Ints], groups: list[Ints], layout: Layout | None,
) -> tuple[list[Ints], str]:  # fmt: skip
    """Split a continuous recording where inspirations begin.

    Args:
        file: names the recording in messages.
        time: times, s, shape ``(N,)``; NaN where there is none.
        values: measured columns by role, in the units of the schema, ``(N,)`` each.
        other: further columns by role, ``(N,)`` each.
        keys: columns a change of which begins a breath.
        groups: those of them that only tell recordings apart.
        layout: known layout of the file, if it is one.

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
        lead = layout.lead if layout is not None else 0.0
        if lead and usual:
            at = np.flatnonzero(starts & ~broken) - round(lead / usual)
            starts = broken.copy()
            starts[at[at > 0]] = True
        how = "by the column that numbers them"
    else:
        gaps = (steps < 0) | (steps > _GAP * max(usual, 1e-9))
        broken[1:] |= gaps[1:]
        onsets, how = _onsets(file, time, values, other)
        starts = broken.copy()
        starts[onsets] = True
    pieces = np.split(rows, np.flatnonzero(starts)[1:])
    kept, short, timeless = [], 0, 0
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
        kept.append(piece)
    if not kept:
        raise InputError(
            f"{file}: no whole breath was found {how}; a breath lasts {_SHORTEST:g} to "
            f"{_LONGEST:g} s. Check the rate and the units, or map a column that numbers breaths "
            "with --map NAME=breath"
        )
    left = f"; {short} pieces that are no whole breath were left out" if short else ""
    if timeless:
        left += f"; {timeless} without times were left out"
    return kept, f"{len(kept)} breaths, split {how}{left}."


def expiratory_valve(
    values: Mapping[str, Floats], other: Mapping[str, Floats], pieces: list[Ints]
) -> tuple[NDArray[np.int8], str]:
    """Return u_out of each row, ``(N,)``, and a sentence that says where it is from.

    Args:
        values: measured columns by role, in the units of the schema, ``(N,)`` each.
        other: further columns by role, ``(N,)`` each.
        pieces: rows of each breath.
    """
    if "u_out" in other:
        return (other["u_out"] > 0.5).astype(np.int8), "u_out is that of the file."
    if "target" in other:
        u_out = (~_is_high(other["target"])).astype(np.int8)
        return u_out, "u_out is 1 where the target is low."
    u_out = np.zeros(len(values["pressure"]), np.int8)
    if "flow" in values:
        flow = np.nan_to_num(values["flow"])
        limit = -0.02 * float(np.quantile(np.abs(flow), 0.99))
        for piece in pieces:
            out = np.flatnonzero(flow[piece] < limit)
            inward = np.flatnonzero(flow[piece] > -limit)
            first = out[out > (inward[0] if len(inward) else -1)]
            if len(first):
                u_out[piece[first[0]] : piece[-1] + 1] = 1
        return u_out, "u_out is 1 from where flow turns outwards."
    for piece in pieces:
        p = _bridged(values["pressure"])[piece]
        peak = int(np.argmax(p))
        half = 0.5 * (p[peak] + p[-1])
        below = np.flatnonzero(p[peak:] < half)
        if len(below):
            u_out[piece[peak + below[0]] : piece[-1] + 1] = 1
    return u_out, "u_out is 1 from where pressure has fallen half-way from its peak (a guess)."


def _onsets(
    file: str, time: Floats, values: Mapping[str, Floats], other: Mapping[str, Floats]
) -> tuple[Ints, str]:
    """Rows at which inspirations begin, and what shows them."""
    if "u_out" in other:
        shut = other["u_out"] < 0.5
        return np.flatnonzero(shut[1:] & ~shut[:-1]) + 1, "where the expiratory valve closes"
    if "target" in other:
        high = _is_high(other["target"])
        return np.flatnonzero(high[1:] & ~high[:-1]) + 1, "where the target rises"
    if "u_in" in values and np.nanmax(values["u_in"]) > 0:
        on = np.nan_to_num(values["u_in"]) > 0
        away = _after_pause(on, time)
        return away, "where the inspiratory valve opens"
    if "flow" in values and np.isfinite(values["flow"]).any():
        flow = np.nan_to_num(values["flow"])
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


def _crossings(signal: Floats, high: float, low: float) -> Ints:
    """Rows before which a signal was low for the last time before it becomes high."""
    onsets, last, armed = [], 0, False
    for k, value in enumerate(signal.tolist()):
        if value <= low:
            last, armed = k, True
        elif value >= high and armed:
            onsets.append(last)
            armed = False
    return np.array(onsets, np.int64)


def _after_pause(on: Bools, time: Floats) -> Ints:
    """Rows at which a valve opens after it was shut for a while."""
    onsets, shut_since = [], None
    for k in range(len(on)):
        if not on[k]:
            shut_since = k if shut_since is None else shut_since
        elif shut_since is not None:
            if time[k] - time[shut_since] >= 0.2:
                onsets.append(k)
            shut_since = None
    return np.array(onsets, np.int64)


def _is_high(signal: Floats) -> Bools:
    """Whether a signal of two levels is at the upper one."""
    return signal > 0.5 * (np.nanmin(signal) + np.nanmax(signal))


def _bridged(values: Floats) -> Floats:
    """Values with their blanks interpolated, shape ``(N,)``."""
    known = np.isfinite(values)
    return np.interp(np.arange(len(values)), np.flatnonzero(known), values[known])
