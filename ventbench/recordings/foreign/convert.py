"""Waveforms of another laboratory as breaths: columns, units, breaths, valves; and a report.

A continuous recording is split where inspirations begin: at the number of the breath, at the
command of a valve, at the flow, or at the pressure, whichever there is, in this order. Nothing is
resampled or smoothed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError
from ventbench.lungs import Lung
from ventbench.recordings.breaths import FILL, Breaths, stack, stack_times, valid_mask
from ventbench.recordings.foreign.breath_onsets import bridged, find_breaths, is_high
from ventbench.recordings.foreign.layouts import LAYOUTS, ROLES, USUAL, Layout, recognise
from ventbench.recordings.foreign.tables import Conversion, Table, conversion, read_table
from ventbench.recordings.schema import COLUMNS

Floats = NDArray[np.float64]

#: Roles with units.
_MEASURED = ("time", "pressure", "flow", "volume", "u_in")

#: Rows of the preview.
_PREVIEW = 5

#: Largest usual sizes, to warn of a forgotten unit: flow of an adult in mL/s is above the first,
#: volume in mL above the second.
_SMALL_FLOW, _SMALL_VOLUME, _SMALL_PRESSURE = 150.0, 5.0, 2.0


@dataclass(frozen=True, eq=False)
class Imported:
    """An imported recording.

    Attributes:
        breaths: the breaths, in the units of the schema.
        conversions: change of units by role.
        columns: role of each column of the file that is used.
        understood: what was understood, a sentence each.
        warnings: what may be wrong, a sentence each.
        preview: the first rows as they are written.
    """

    breaths: Breaths
    conversions: Mapping[str, Conversion]
    columns: Mapping[str, str]
    understood: tuple[str, ...]
    warnings: tuple[str, ...]
    preview: str

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "breaths": len(self.breaths),
            "samples": int(self.breaths.valid.sum()),
            "lungs": {name: len(index) for name, index in self.breaths.by_lung_index.items()},
            "columns": dict(self.columns),
            "units": {
                role: {
                    "unit": change.unit,
                    "to": change.to,
                    "numerator": change.factor.numerator,
                    "denominator": change.factor.denominator,
                }
                for role, change in self.conversions.items()
            },
            "understood": list(self.understood),
            "warnings": list(self.warnings),
        }


def import_recording(
    path: str | Path,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    layout: str | None = None,
    lung: str | None = None,
    rate: float | None = None,
    split_breaths: bool = False,
    invert: Iterable[str] = (),
    select: Mapping[str, str] | None = None,
    separator: str | None = None,
    decimal: str | None = None,
) -> Imported:
    """Read a recording of another laboratory.

    Args:
        path: text with any separator (also gzipped), Parquet or MATLAB up to version 7.
        columns: role of each column, ``{"Paw": "pressure"}``; the roles are ``time``,
            ``pressure``, ``flow``, ``volume``, ``u_in``, ``u_out``, ``R``, ``C``, ``breath``,
            ``group`` (a breath ends where it changes) and ``target`` (inspiration is where it is
            high). Columns of usual names need none.
        units: unit by role where it is not that of the header or of the schema,
            ``{"flow": "L/min"}``.
        layout: name of a known layout, see :data:`~.layouts.LAYOUTS`; recognised if None.
        lung: label such as ``"R20C50"`` where no columns hold R and C.
        rate: sampling rate, Hz, where no column holds the time.
        split_breaths: split at inspirations even if a column numbers the breaths.
        invert: roles whose sign is the opposite, such as ``flow``.
        select: values that columns must have, ``{"run": "a", "test": "1"}``; other rows are left
            out.
        separator: separator of the cells; found out if None.
        decimal: ``"."`` or ``","``; found out if None.

    Raises:
        InputError: if a column is missing, a unit is unknown, or there is no breath.

    Example:
        >>> import ventbench
        >>> imported = ventbench.import_recording(
        ...     "lab.csv", columns={"Paw": "pressure"}, units={"flow": "L/min"}, lung="R20C50"
        ... )  # doctest: +SKIP
    """
    table = read_table(path, separator=separator, decimal=decimal)
    table, selected = _selected(table, dict(select or {}))
    known = _layout(layout, table)
    roles = _roles(table, dict(columns or {}), known)
    by_role = {role: name for name, role in roles.items() if role not in ("group",)}
    if "pressure" not in by_role:
        raise InputError(
            f"{table.file}: no column is the pressure; the columns are "
            f"{', '.join(table.columns)}. Say which with --map NAME=pressure"
        )
    changes = _conversions(table, by_role, dict(units or {}), known)
    notes, warnings = [*table.notes, *selected], []
    if known is not None:
        notes.append(f"Layout {known.name}: {known.about}.")
    values = {
        role: changes[role].apply(_numbers(table, name))
        for role, name in by_role.items()
        if role in _MEASURED
    }
    for role in ("flow", "volume"):
        if role in values and not np.isfinite(values[role]).any():
            notes.append(f"Column {by_role[role]} is blank throughout.")
            del values[role]
    for role in invert:
        if role not in values:
            raise InputError(f"--invert {role}: no column is {role}")
        values[role] = -values[role]
    if not np.isfinite(values["pressure"]).any():
        raise InputError(
            f"{table.file}, column {by_role['pressure']}: every pressure is blank, so there is "
            "nothing to compare a simulator with"
        )
    other = {
        role: _numbers(table, name)
        for role, name in by_role.items()
        if role not in _MEASURED and role not in ("group", "breath")
    }
    keys = [
        _labels(table.columns[name])
        for name, role in roles.items()
        if role == "group" or (role == "breath" and not split_breaths)
    ]
    groups = [_labels(table.columns[n]) for n, role in roles.items() if role == "group"]
    time, how = _time(table, values.get("time"), rate, keys)
    notes.append(how)
    pieces, how = find_breaths(table.file, time, values, other, keys, groups, known)
    notes.append(how)
    R, C, how = _lung(lung, other, len(table))
    notes.append(how)
    u_out, how = _valve(values, other, pieces, time)
    notes.append(how)
    u_in = values.get("u_in")
    if u_in is None:
        u_in = np.zeros(len(table))
        notes.append(
            "No valve command: u_in is 0 throughout."
            + (
                " A diagnosis then runs from the recorded flow."
                if {"flow", "volume"} & set(values)
                else " Without flow or volume, nothing can be diagnosed."
            )
        )
    u_in = np.where(np.isfinite(u_in), u_in, 0.0)
    samples = {
        "u_in": u_in, "u_out": u_out, "pressure": values["pressure"],
        **{name: values[name] for name in ("flow", "volume") if name in values},
    }  # fmt: skip
    _check_ranges(table, by_role, samples, R, C, pieces)
    warnings += _suspicious(samples, changes)
    breaths = _breaths(str(path), pieces, time, samples, R, C, notes)
    return Imported(
        breaths, changes, roles, tuple(notes), tuple(warnings), _preview(breaths)
    )  # fmt: skip


def _selected(table: Table, select: dict[str, str]) -> tuple[Table, list[str]]:
    """Rows whose columns have given values."""
    keep = np.ones(len(table), bool)
    for name, value in select.items():
        if name not in table.columns:
            raise InputError(
                f"--select {name}={value}: {table.file} has no column {name}; it has "
                f"{', '.join(table.columns)}"
            )
        keep &= np.array([_same(cell, value) for cell in table.columns[name].tolist()])
    if not keep.any():
        asked = ", ".join(f"{n}={v}" for n, v in select.items())
        raise InputError(f"{table.file}: no row has {asked}")
    if keep.all():
        return table, []
    columns = {name: values[keep] for name, values in table.columns.items()}
    note = f"{int(keep.sum())} of {len(keep)} rows were selected."
    return Table(table.file, columns, table.units, None, table.scalars, table.notes), [note]


def _same(cell: Any, value: str) -> bool:
    if str(cell) == value:
        return True
    try:
        return float(cell) == float(value)
    except ValueError:
        return False


def _layout(name: str | None, table: Table) -> Layout | None:
    if name is None:
        return recognise(tuple(table.columns))
    if name not in LAYOUTS:
        raise InputError(f"--layout {name}: choose one of {', '.join(LAYOUTS)}")
    missing = [c for c in LAYOUTS[name].required if c not in table.columns]
    if missing:
        raise InputError(
            f"{table.file} is not of layout {name}: it has no column {', '.join(missing)}"
        )
    return LAYOUTS[name]


def _roles(table: Table, given: dict[str, str], layout: Layout | None) -> dict[str, str]:
    """Role of each column: as given, by the layout, by its usual name; the first of each role."""
    for name, role in given.items():
        if role not in ROLES:
            raise InputError(f"--map {name}={role}: a column may be {', '.join(ROLES)}")
        if name not in table.columns:
            close = get_close_matches(name, table.columns, n=1)
            hint = f" Perhaps {close[0]!r}." if close else ""
            raise InputError(
                f"--map {name}={role}: {table.file} has no column {name!r}; it has "
                f"{', '.join(table.columns)}.{hint}"
            )
    roles = dict(given)
    taken = {role for role in given.values() if role != "group"}
    known = layout.columns if layout is not None else {}
    for name in table.columns:
        role = known.get(name) or (USUAL.get(name.lower()) if layout is None else None)
        if name not in roles and role is not None and role not in taken:
            roles[name] = role
            if role != "group":
                taken.add(role)
    for role in set(roles.values()) - {"group"}:
        names = [name for name, own in roles.items() if own == role]
        if len(names) > 1:
            raise InputError(f"columns {' and '.join(names)} are both {role}; map one of them")
    return roles


def _conversions(
    table: Table, by_role: Mapping[str, str], units: dict[str, str], layout: Layout | None
) -> dict[str, Conversion]:
    for role in units:
        if role not in _MEASURED:
            raise InputError(f"{role} has no unit; units are for {', '.join(_MEASURED)}")
    known = layout.units if layout is not None else {}
    return {
        role: conversion(role, units.get(role) or table.units.get(name) or known.get(role))
        for role, name in by_role.items()
        if role in _MEASURED
    }


def _numbers(table: Table, name: str) -> Floats:
    values = table.columns[name]
    if values.dtype.kind not in "fiub":
        raise InputError(
            f"{table.file}, column {name}: its cells are no numbers, such as {str(values[0])!r}"
        )
    return np.asarray(values, float)


def _labels(values: NDArray[Any]) -> NDArray[np.int64]:
    """Number of each distinct value."""
    return np.unique(values, return_inverse=True)[1].reshape(-1)


def _time(
    table: Table, time: Floats | None, rate: float | None, keys: list[NDArray[np.int64]]
) -> tuple[Floats, str]:
    """Time of each row, s; NaN where the file leaves it blank."""
    if rate is None and time is None:
        rates = {k: v for k, v in table.scalars.items() if k.lower().split(".")[-1] in _RATES}
        if not rates:
            raise InputError(
                f"{table.file}: no column is the time; say which with --map NAME=time, or give "
                "the sampling rate with --rate 50"
            )
        name, rate = next(iter(rates.items()))
        return np.arange(len(table)) / rate, f"Sampling rate {rate:g} Hz, from {name}."
    if rate is not None:
        if rate <= 0:
            raise InputError(f"--rate {rate:g}: a positive rate in Hz is needed")
        return np.arange(len(table)) / rate, f"Sampling rate {rate:g} Hz, as given."
    assert time is not None
    steps = np.diff(time)
    inside = np.isfinite(steps)
    for key in keys:
        inside &= np.diff(key) == 0
    if not inside.any():
        return time, "Times are blank in part."
    if np.median(steps[inside]) <= 0:
        raise InputError(f"{table.file}: the time does not increase")
    median = float(np.median(steps[inside & (steps > 0)]))
    return time, f"Sampling interval {1e3 * median:.4g} ms (median), {1 / median:.4g} Hz."


#: Names of a sampling rate among the single numbers of a MATLAB file.
_RATES = ("fs", "rate", "sampling_rate", "samplingrate", "samplerate", "sample_rate", "freq")


def _lung(given: str | None, other: Mapping[str, Floats], count: int) -> tuple[Floats, Floats, str]:
    """R and C of each row."""
    from ventbench.lungs import lung as parse

    if given is not None:
        label: Lung = parse(given)
        return np.full(count, label.R), np.full(count, label.C), f"Lung {label.id}, as given."
    if "R" in other and "C" in other:
        pairs = np.unique(np.stack([other["R"], other["C"]], axis=1), axis=0)
        ids = ", ".join(f"R{R:g}C{C:g}" for R, C in pairs[:9].tolist())
        return other["R"], other["C"], f"Lungs of the file: {ids}."
    raise InputError(
        "no columns hold R and C of the lung; give --lung R20C50 (a guess is enough: R in "
        "cmH2O/(L/s) and C in mL/cmH2O are fitted again), or map the columns"
    )


def _valve(
    values: Mapping[str, Floats], other: Mapping[str, Floats], pieces: list[NDArray[np.int64]],
    time: Floats,
) -> tuple[NDArray[np.int8], str]:  # fmt: skip
    """u_out of each row, and where it is from."""
    if "u_out" in other:
        return (other["u_out"] > 0.5).astype(np.int8), "u_out is that of the file."
    if "target" in other:
        u_out = (~is_high(other["target"])).astype(np.int8)
        return u_out, "u_out is 1 where the target is low."
    u_out = np.zeros(len(time), np.int8)
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
        p = bridged(values["pressure"])[piece]
        peak = int(np.argmax(p))
        half = 0.5 * (p[peak] + p[-1])
        below = np.flatnonzero(p[peak:] < half)
        if len(below):
            u_out[piece[peak + below[0]] : piece[-1] + 1] = 1
    return u_out, "u_out is 1 from where pressure has fallen half-way from its peak (a guess)."


def _check_ranges(
    table: Table, by_role: Mapping[str, str], samples: Mapping[str, NDArray[Any]],
    R: Floats, C: Floats, pieces: list[NDArray[np.int64]],
) -> None:  # fmt: skip
    """Refuse what the schema cannot hold: one sentence a column."""
    rows, problems = np.concatenate(pieces), []
    for name, values in {**samples, "R": R, "C": C}.items():
        column, own = COLUMNS[name], np.asarray(values, float)[rows]
        low = own <= column.low if column.positive else own < column.low
        wrong = np.flatnonzero(low | (own > column.high) | (np.isnan(own) & (not column.blank)))
        if len(wrong):
            row = int(rows[wrong[0]])
            where = f"row {row + 1}"
            if table.first_line is not None:
                where = f"line {table.first_line + row}"
            problems.append(
                f"{table.file}, column {by_role.get(name, name)}: {len(wrong)} of {len(own)} "
                f"values are outside {column.span}, the first in {where} ({own[wrong[0]]:g}). "
                "Check the unit (such as --flow-unit L/min) and the map."
            )
    if problems:
        raise InputError("\n".join(problems))


def _suspicious(
    samples: Mapping[str, NDArray[Any]], changes: Mapping[str, Conversion]
) -> list[str]:
    """Sizes that look like a forgotten unit, and signs that look inverted."""
    warnings = []
    for role, small, advice in (
        ("flow", _SMALL_FLOW, "--flow-unit L/min or L/s"),
        ("volume", _SMALL_VOLUME, "--volume-unit L"),
        ("pressure", _SMALL_PRESSURE, "--pressure-unit kPa"),
    ):
        if role in samples and np.isfinite(samples[role]).any():
            size = float(np.nanquantile(np.abs(samples[role]), 0.99))
            if size < small:
                warnings.append(
                    f"{role} is {size:.3g} {changes[role].to} at most (99 %), which is little; is "
                    f"the unit right ({advice})?"
                )
    if "flow" in samples and "u_out" in samples:
        flow = samples["flow"]
        inside, known = samples["u_out"] == 0, np.isfinite(flow)
        if (inside & known).any() and (~inside & known).any():
            into, out = flow[inside & known].mean(), flow[~inside & known].mean()
            if into < 0.0 < out:
                warnings.append("flow is negative in inspirations; pass --invert flow if so.")
    return warnings


def _breaths(
    source: str, pieces: list[NDArray[np.int64]], time: Floats,
    samples: Mapping[str, NDArray[Any]], R: Floats, C: Floats, notes: list[str],
) -> Breaths:  # fmt: skip
    rows, lengths = np.concatenate(pieces), np.array([len(piece) for piece in pieces])
    first = np.array([piece[0] for piece in pieces])
    for name, values in (("R", R), ("C", C)):
        for piece in pieces:
            if np.any(values[piece] != values[piece[0]]):
                raise InputError(
                    f"{source}: {name} changes within the breath of row {piece[0] + 1}"
                )
    parts = []
    for piece in pieces:
        at, k = time[piece], np.arange(len(piece))
        known = np.isfinite(at)
        at = np.interp(k, k[known], at[known]) if not known.all() else at
        parts.append(at - at[0])
    stacked, dt = stack_times(np.concatenate(parts), lengths)
    arrays = {name: stack(values[rows], lengths, FILL[name]) for name, values in samples.items()}
    return Breaths(
        breath_id=np.arange(1, len(pieces) + 1), R=R[first].astype(float),
        C=C[first].astype(float), time=stacked, dt=dt, valid=valid_mask(lengths),
        time_inferred=np.zeros(len(pieces), bool), u_in=arrays["u_in"].astype(float),
        u_out=arrays["u_out"].astype(np.int8), pressure=arrays["pressure"].astype(float),
        flow=arrays.get("flow"), volume=arrays.get("volume"), source=source, notes=tuple(notes),
    )  # fmt: skip


def _preview(breaths: Breaths) -> str:
    """The first rows as text."""
    names = ["time_step", "u_in", "u_out", "pressure"]
    columns = [breaths.time, breaths.u_in, breaths.u_out, breaths.pressure]
    for name in ("flow", "volume"):
        values = getattr(breaths, name)
        if values is not None:
            names.append(name)
            columns.append(values)
    lines = ["  ".join(f"{name:>9}" for name in names)]
    for k in range(min(_PREVIEW, breaths.time.shape[1])):
        lines.append("  ".join(f"{float(column[0, k]):>9.4g}" for column in columns))
    return "\n".join(lines)
