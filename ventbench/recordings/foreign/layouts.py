"""Units of columns, layouts known by name, and where inspirations begin.

Factors of units are exact. An inspiration begins at a number, a valve, the flow or the pressure.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError

#: Pascal in a centimetre of water (conventional, at 4 degrees Celsius) and of other units.
_PASCAL = {
    "cmH2O": Fraction("98.0665"),
    "mbar": Fraction(100),
    "hPa": Fraction(100),
    "kPa": Fraction(1000),
    "Pa": Fraction(1),
    "mmHg": Fraction("133.322387415"),
    "mmH2O": Fraction("9.80665"),
    "psi": Fraction("6894.757293168"),
}

#: Factors to the schema's unit, which is the first of each role.
UNITS: dict[str, dict[str, Fraction]] = {
    "pressure": {name: value / _PASCAL["cmH2O"] for name, value in _PASCAL.items()},
    "flow": {
        "mL/s": Fraction(1),
        "L/s": Fraction(1000),
        "L/min": Fraction(50, 3),
        "mL/min": Fraction(1, 60),
        "L/h": Fraction(5, 18),
    },
    "volume": {"mL": Fraction(1), "L": Fraction(1000)},
    "time": {
        "s": Fraction(1),
        "ms": Fraction(1, 1000),
        "us": Fraction(1, 1_000_000),
        "min": Fraction(60),
    },
    "u_in": {"%": Fraction(1), "1": Fraction(100)},
}

#: Other spellings, without blanks and in lower case. Standard litres are taken as litres.
_SPELLINGS = {
    "lpm": "L/min",
    "slpm": "L/min",
    "slm": "L/min",
    "sl/min": "L/min",
    "nl/min": "L/min",
    "lps": "L/s",
    "lmin-1": "L/min",
    "ls-1": "L/s",
    "mls-1": "mL/s",
    "mlps": "mL/s",
    "cmh20": "cmH2O",
    "sec": "s",
    "seconds": "s",
    "secs": "s",
    "msec": "ms",
    "millis": "ms",
    "milliseconds": "ms",
    "µs": "us",
    "μs": "us",
    "percent": "%",
    "0..1": "1",
    "0-1": "1",
    "minutes": "min",
}


@dataclass(frozen=True)
class Conversion:
    """An exact change of units."""

    unit: str  #: unit in the file.
    to: str  #: unit of the schema.
    factor: Fraction  #: one ``unit`` in ``to``; its reciprocal is the exact way back.

    def apply(self, values: Floats) -> Floats:
        """Convert; one rounding to the nearest number at most for each of two integers."""
        return np.asarray(values, float) * self.factor.numerator / self.factor.denominator

    def __str__(self) -> str:
        """The change in words, with the way back."""
        if self.factor == 1:
            return self.to
        return f"{self.unit} -> {self.to}, x {_in_words(self.factor)} (back: x {_in_words(1 / self.factor)})"  # noqa: E501


def conversion(role: str, unit: str | None) -> Conversion:
    """Return the change from a unit of a role in :data:`UNITS` to the schema's, which None is.

    Raises:
        InputError: if the role has no such unit.
    """
    known = UNITS[role]
    to = next(iter(known))
    name = to if unit is None else spelled(unit)
    if name not in known:
        raise InputError(
            f"{unit!r} is no unit of {role} that is known; choose one of {', '.join(known)}"
        )
    return Conversion(name, to, known[name])


def in_file_unit(change: Conversion, pascal: float) -> float:
    """A pressure in the unit of a file."""
    return pascal / float(_PASCAL[change.unit])


def spelled(unit: str) -> str:
    """Return the usual spelling of a unit, or the unit as it is if it is not known."""
    plain = re.sub(r"[\s·*^_]", "", unit.strip().strip("[](){}<>")).replace("per", "/")
    return _SPELLINGS.get(plain.lower(), _BY_LOWER.get(plain.lower(), unit.strip()))


_BY_LOWER = {unit.lower(): unit for units in UNITS.values() for unit in units}


def is_unit(text: str) -> bool:
    """Whether a text spells a known unit."""
    return spelled(text) in _BY_LOWER.values() and spelled(text) != "1"


def unit_of(header: str) -> tuple[str, str | None]:
    """Split a header into its name and its unit, if it has one.

    ``Flow [L/min]`` and ``Flow, L/min`` are ``Flow``; ``Flow_LPM`` keeps its whole name.
    """
    header = header.strip()
    match = re.fullmatch(r"(.+?)\s*[\[({<]([^\])}>]*)[\])}>]", header)
    if match is not None:
        return match[1].strip(" _,"), spelled(match[2]) if match[2].strip() else None
    match = re.fullmatch(r"(.*[^\s_,;:./-])([\s_,;:.-]+)(\S+)", header)
    if match is None or not is_unit(match[3]):
        return header, None
    return header if match[2] in "_.-" else match[1], spelled(match[3])


def stem(name: str) -> str:
    """The name of a column in lower case, without its unit, blanks and marks."""
    match = re.fullmatch(r"(.+)[\s_,;:.-]+(\S+)", name.strip())
    if match is not None and is_unit(match[2]):
        name = match[1]
    return re.sub(r"[^\w]|_", "", name.rpartition(".")[2] or name).lower()


def _in_words(factor: Fraction) -> str:
    if factor.denominator == 1 or factor.numerator == 1 or factor.denominator < 1000:
        return str(factor)
    return f"{float(factor):.10g}"


#: What a column may stand for.
ROLES = (
    "time",
    "pressure",
    "flow",
    "volume",
    "u_in",
    "u_out",
    "R",
    "C",
    "breath",
    "group",
    "target",
    "unused",
)


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
                "time_step": "time",
                "breath_id": "breath",
                "R": "R",
                "C": "C",
                "u_in": "u_in",
                "u_out": "u_out",
                "pressure": "pressure",
                "flow": "flow",
                "volume": "volume",
            },
            required=("breath_id", "R", "C", "time_step", "u_in", "u_out"),
        ),
        Layout(
            "respiraworks",
            "RespiraWorks test data as one table, a run and a test a recording; its valve commands "
            "are those of another ventilator and are left out",
            {
                "time_step": "time",
                "run": "group",
                "test": "group",
                "breath": "breath",
                "R": "R",
                "C": "C",
                "pressure": "pressure",
                "flow": "flow",
                "volume": "volume",
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
                "timestamp": "time",
                "pressure": "pressure",
                "control_in": "u_in",
                "control_out": "u_out",
                "cycle_number": "breath",
            },
            required=("timestamp", "pressure", "control_in", "control_out", "cycle_number"),
        ),
        Layout(
            "servo",
            "what a Servo ventilator exports as text, [REC] in the first line, in any language; "
            "inspirations are the phases in which more flows in than out",
            {
                "time": "time",
                "pressure": "pressure",
                "flow": "flow",
                "volume": "volume",
                "expiration": "u_out",
            },
            required=("time", "pressure", "flow", "expiration"),
        ),
    )
}

_NAMES: dict[str, str] = {
    "time": "time timestep timestamp t zeit tempo temps tiempo clock datetime elapsed elapsedtime "
    "relativetime seconds",
    "pressure": "pressure paw airwaypressure p pao pvent pmouth pcircuit druck pressione pression "
    "presion",
    "flow": "flow flowrate airflow q vdot fluss flusso debit flujo",
    "volume": "volume vol v volumen",
    "u_in": "uin",
    "u_out": "uout",
    "R": "r",
    "C": "c",
    "breath": "breath breathid cyclenumber breathnumber",
}

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
    file: str,
    time: Floats,
    values: Mapping[str, Floats],
    other: Mapping[str, Floats],
    keys: list[Ints],
    groups: list[Ints],
    layout: Layout | None,
) -> tuple[list[Ints], str]:
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
