"""Waveforms of another laboratory as breaths: columns, units, breaths, valves; and a report.

A continuous recording is split where inspirations begin: at the number of the breath, at the
command of a valve, at the flow, or at the pressure, whichever there is, in this order. Nothing is
resampled or smoothed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths, arranged
from ventbench.recordings.foreign.formats import read_table
from ventbench.recordings.foreign.layouts import (
    LAYOUTS,
    ROLES,
    USUAL,
    Conversion,
    Layout,
    conversion,
    expiratory_valve,
    find_breaths,
    in_file_unit,
    recognise,
    stem,
)
from ventbench.recordings.foreign.tables import Table
from ventbench.recordings.roles import SLOW, check_roles, few_breaths, opposite_sign
from ventbench.recordings.schema import COLUMNS
from ventbench.task.lungs import Lung

#: Roles with units.
_MEASURED = ("time", "pressure", "flow", "volume", "u_in")

#: Flow, mL/s, and volume, mL, below which another unit is likely; pressure, cmH2O, from which it
#: is absolute.
_SMALL_FLOW, _SMALL_VOLUME, _ABSOLUTE = 150.0, 5.0, 500.0

#: Share of the steps of a clock that may be zero.
_STANDS_STILL = 0.2


@dataclass(frozen=True, eq=False)
class Imported:
    """An imported recording."""

    breaths: Breaths  #: the breaths, in the units of the schema.
    conversions: Mapping[str, Conversion]  #: change of units by role.
    columns: Mapping[str, str]  #: role of each column of the file that is used.
    understood: tuple[str, ...]  #: what was understood, a sentence each.
    warnings: tuple[str, ...]  #: what may be wrong, a sentence each.

    @property
    def preview(self) -> str:
        """The first rows as they are written."""
        return self.breaths.to_frame().head(5).to_string(index=False)

    def __repr__(self) -> str:
        """Breaths and columns."""
        return f"<Imported: {len(self.breaths)} breaths, columns {', '.join(self.columns)}>"

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
    path: str | Path | Table,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    layout: str | None = None,
    lung: str | None = None,
    rate: float | None = None,
    split_breaths: bool = False,
    invert: Iterable[str] = (),
    offsets: Mapping[str, float] | None = None,
    select: Mapping[str, str] | None = None,
    skip_bad_breaths: bool = False,
    separator: str | None = None,
    decimal: str | None = None,
) -> Imported:
    """Read a recording of another laboratory.

    Args:
        path: text with any separator (also gzipped), a spreadsheet, Parquet, MATLAB, EDF, BDF, or
            the header (.hea) of a WFDB record; or what has been read of one.
        columns: role of each column, ``{"Paw": "pressure"}``; the roles are ``time``,
            ``pressure``, ``flow``, ``volume``, ``u_in``, ``u_out``, ``R``, ``C``, ``breath``,
            ``group`` (a breath ends where it changes), ``target`` (inspiration is where it is
            high) and ``unused``. Columns of usual names need none.
        units: unit by role where it is not that of the header or of the schema,
            ``{"flow": "L/min"}``.
        layout: name of a known layout, see :data:`~.layouts.LAYOUTS`; recognised if None.
        lung: label such as ``"R20C50"`` where no columns hold R and C.
        rate: sampling rate, Hz, where no column holds the time, or only a coarse one.
        split_breaths: split at inspirations even if a column numbers the breaths.
        invert: roles whose sign is the opposite, such as ``flow``; of valves, 0 and 1 (100 %).
        offsets: what is added by role, in the unit of the file, ``{"pressure": -1013.25}``.
        select: values that columns must have, ``{"run": "a", "test": "1"}``; other rows are left
            out.
        skip_bad_breaths: leave out breaths that the schema cannot hold, and name them.
        separator: separator of the cells; found out if None.
        decimal: ``"."`` or ``","``; found out if None.

    Raises:
        InputError: if a column is missing, a unit is unknown, there is no breath, or columns are
            not what they are called.

    Example:
        >>> import ventbench
        >>> imported = ventbench.import_recording(
        ...     "lab.csv", columns={"Paw": "pressure"}, units={"flow": "L/min"}, lung="R20C50"
        ... )  # doctest: +SKIP
    """
    table = path
    if not isinstance(table, Table):
        table = read_table(table, separator=separator, decimal=decimal)
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
    added = dict(offsets or {})
    values = {
        role: changes[role].apply(_numbers(table, name) + added.pop(role, 0.0))
        for role, name in by_role.items()
        if role in _MEASURED and not (role == "time" and rate is not None)
    }
    if added:
        raise InputError(f"--offset {next(iter(added))}: no column is {next(iter(added))}")
    for role in ("flow", "volume"):
        if role in values and not np.isfinite(values[role]).any():
            notes.append(f"Column {by_role[role]} is blank throughout.")
            del values[role]
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
    _invert(values, other, invert)
    _check_signs(table, by_role, values, changes)
    keys = [
        _labels(table.columns[name])
        for name, role in roles.items()
        if role == "group" or (role == "breath" and not split_breaths)
    ]
    groups = [_labels(table.columns[n]) for n, role in roles.items() if role == "group"]
    time, how = _time(table, values.get("time"), rate, keys)
    notes.append(how)
    unused = [name for name in table.columns if roles.get(name, "unused") == "unused"]
    unused += [by_role["time"]] if rate is not None and "time" in by_role else []
    if unused:
        notes.append(f"Columns that are not used: {', '.join(unused)}.")
    pieces, how = find_breaths(table.file, time, values, other, keys, groups, known)
    notes.append(how)
    R, C, how = _lung(lung, other, len(table))
    notes.append(how)
    u_out, how = expiratory_valve(values, other, pieces)
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
        "u_in": u_in,
        "u_out": u_out,
        "pressure": values["pressure"],
        **{name: values[name] for name in ("flow", "volume") if name in values},
    }
    labelled = {**samples, "R": R, "C": C}
    pieces, left = _sound(table, by_role, labelled, time, pieces, skip_bad_breaths)
    notes += left
    warnings += _suspicious(samples, changes)
    breaths = _breaths(table.file, pieces, time, samples, R, C, notes)
    few = few_breaths(len(breaths))
    found = check_roles(breaths)
    if found and found[0].level == "refused":
        raise InputError(f"{table.file}, column {by_role.get(found[0].column)}: {found[0]}")
    warnings += [str(finding) for finding in found]
    notes += [few] if few is not None else []
    used = {name: role for name, role in roles.items() if role != "unused"}
    return Imported(breaths, changes, used, tuple(notes), tuple(warnings))


def import_runs(path: str | Path) -> dict[str, Breaths]:
    """Read each recording of a Parquet file whose layout tells several apart.

    Errors are those of :func:`import_recording`.

    Returns:
        Breaths by the values of the columns that do, in the order of the file: of RespiraWorks by
        run and test, ``"2020-07-31-UFlow-Performance 4"``. Nothing of any other file.
    """
    import pyarrow as pa
    from pyarrow import parquet

    try:
        layout = recognise(tuple(parquet.read_schema(path).names))
    except (pa.ArrowException, OSError):
        return {}
    groups = [name for name, role in layout.columns.items() if role == "group"] if layout else []
    if not groups:
        return {}
    table = read_table(path)
    cells = (
        [f"{value:g}" if isinstance(value, float) else value for value in column]
        for column in (table.columns[name].tolist() for name in groups)
    )
    keys = np.array([" ".join(row) for row in zip(*cells, strict=True)])
    return {
        key: import_recording(_rows(table, keys == key)).breaths
        for key in dict.fromkeys(keys.tolist())
    }


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
    return _rows(table, keep), [f"{int(keep.sum())} of {len(keep)} rows were selected."]


def _rows(table: Table, keep: Bools) -> Table:
    columns = {name: values[keep] for name, values in table.columns.items()}
    lines = None if table.lines is None else table.lines[keep]
    return replace(table, columns=columns, lines=lines)


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
    taken = {role for role in given.values() if role not in ("group", "unused")}
    known = layout.columns if layout is not None else {}
    alike: dict[str, list[str]] = {}
    for name in table.columns:
        role = known.get(name) or (USUAL.get(stem(name)) if layout is None else None)
        if name not in roles and role == "group":
            roles[name] = role
        elif name not in roles and role is not None and role not in taken:
            alike.setdefault(role, []).append(name)
    for role, names in alike.items():
        _check_alike(table, role, names)
        roles[names[0]] = role
    for role in set(roles.values()) - {"group", "unused"}:
        names = [name for name, own in roles.items() if own == role]
        if len(names) > 1:
            raise InputError(f"columns {' and '.join(names)} are both {role}; map one of them")
    return roles


def _check_alike(table: Table, role: str, names: Sequence[str]) -> None:
    """Refuse to choose among columns of one role that differ."""
    if role not in _MEASURED or role == "time":
        return
    first = table.columns[names[0]]
    for name in names[1:]:
        second = table.columns[name]
        if first.dtype.kind not in "fiub" or second.dtype.kind not in "fiub":
            continue
        apart = np.abs(np.asarray(first, float) - np.asarray(second, float))
        if np.isfinite(apart).any() and np.nanmax(apart) > 1e-9 * np.nanmax(np.abs(first)):
            raise InputError(
                f"{table.file}: columns {names[0]} and {name} may both be {role}, and differ by "
                f"{np.nanmedian(apart):.3g} (median); say which with --map {name}={role}, or give "
                f"--map {name}=unused"
            )


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


def _labels(values: NDArray[Any]) -> Ints:
    """Number of each distinct value."""
    return np.unique(values, return_inverse=True)[1].reshape(-1)


def _time(
    table: Table, time: Floats | None, rate: float | None, keys: list[Ints]
) -> tuple[Floats, str]:
    """Time of each row, s; NaN where the file leaves it blank."""
    if rate is not None:
        if rate <= 0:
            raise InputError(f"--rate {rate:g}: a positive rate in Hz is needed")
        return np.arange(len(table)) / rate, f"Sampling rate {rate:g} Hz, as given."
    if time is None:
        if table.rate is None:
            raise InputError(
                f"{table.file}: no column is the time; say which with --map NAME=time, or give "
                "the sampling rate with --rate 50"
            )
        return np.arange(len(table)) / table.rate, f"Sampling rate {table.rate:g} Hz, of the file."
    steps = np.diff(time)
    inside = np.isfinite(steps)
    for key in keys:
        inside &= np.diff(key) == 0
    if not inside.any():
        return time, "Times are blank in part."
    onwards = steps[inside & (steps > 0)]
    if len(onwards) == 0:
        raise InputError(f"{table.file}: the time does not increase")
    median = float(np.median(onwards))
    if (steps[inside] == 0).mean() > _STANDS_STILL:
        rows_per_step = float(np.median(np.diff(np.flatnonzero(steps > 0))))
        guess = rows_per_step / median
        raise InputError(
            f"{table.file}: the clock has steps of {1e3 * median:.4g} ms for "
            f"{rows_per_step:.3g} rows each; give the sampling rate, such as "
            f"--rate {guess:.4g}"
        )
    if median > SLOW:
        raise InputError(
            f"{table.file}: the median sampling interval is {median:.4g} s, and rates are 20 to "
            "1000 Hz; give --time-unit ms, or the sampling rate with --rate 100"
        )
    return time, f"Sampling interval {1e3 * median:.4g} ms (median), {1 / median:.4g} Hz."


def _lung(given: str | None, other: Mapping[str, Floats], count: int) -> tuple[Floats, Floats, str]:
    """R and C of each row."""
    from ventbench.task.lungs import lung as parse

    if given is not None:
        label: Lung = parse(given)
        over = " in place of R and C of the file" if "R" in other and "C" in other else ""
        how = f"Lung {label.id}, as given{over}."
        return np.full(count, label.R), np.full(count, label.C), how
    if "R" in other and "C" in other:
        pairs = np.unique(np.stack([other["R"], other["C"]], axis=1), axis=0)
        ids = ", ".join(f"R{R:g}C{C:g}" for R, C in pairs[:9].tolist())
        return other["R"], other["C"], f"Lungs of the file: {ids}."
    raise InputError(
        "no columns hold R and C of the lung; give --lung R20C50 (a guess is enough: R in "
        "cmH2O/(L/s) and C in mL/cmH2O are fitted again), or map the columns"
    )


def _invert(values: dict[str, Floats], other: dict[str, Floats], roles: Iterable[str]) -> None:
    """Change signs; of a valve, what is open."""
    for role in roles:
        if role == "u_out" and role in other:
            other[role] = 1.0 - other[role]
        elif role in values:
            values[role] = 100.0 - values[role] if role == "u_in" else -values[role]
        else:
            raise InputError(f"--invert {role}: no column is {role}")


def _check_signs(
    table: Table,
    by_role: Mapping[str, str],
    values: Mapping[str, Floats],
    changes: Mapping[str, Conversion],
) -> None:
    """Refuse absolute pressure, and flow that is counted from the patient.

    Before anything is inferred from them: breaths and valves would be wrong too.
    """
    pressure = values["pressure"]
    if np.nanmedian(pressure) > _ABSOLUTE:
        change = changes["pressure"]
        raise InputError(
            f"{table.file}, column {by_role['pressure']}: pressure is {np.nanmedian(pressure):.4g} "
            f"cmH2O in the median, so it is absolute; subtract that of the air, in {change.unit}: "
            f"--offset pressure=-{in_file_unit(change, 101325):.6g}"
        )
    if "flow" in values and opposite_sign(pressure, values["flow"]):
        raise InputError(
            f"{table.file}, column {by_role['flow']}: flow goes out while pressure is high, so it "
            "is counted from the patient; give --invert flow"
        )


def _sound(
    table: Table,
    by_role: Mapping[str, str],
    samples: Mapping[str, NDArray[Any]],
    time: Floats,
    pieces: list[Ints],
    skip: bool,
) -> tuple[list[Ints], list[str]]:
    """Breaths that the schema can hold; refuse the others, or leave them out and name them."""
    rows, bad, problems = np.concatenate(pieces), dict[int, str](), list[str]()
    owner = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    for name, values in samples.items():
        column, own = COLUMNS[name], np.asarray(values, float)[rows]
        low = own <= column.low if column.positive else own < column.low
        wrong = np.flatnonzero(low | (own > column.high) | (np.isnan(own) & (not column.blank)))
        if len(wrong):
            problems.append(
                f"{table.file}, column {by_role.get(name, name)}: {len(wrong)} of {len(own)} "
                f"values are outside {column.span}, the first in "
                f"{table.place(int(rows[wrong[0]]))} ({own[wrong[0]]:g}). Check the unit (such as "
                "--flow-unit L/min) and the map."
            )
        for at in wrong[np.unique(owner[wrong], return_index=True)[1]]:
            bad.setdefault(int(owner[at]), f"{name} is {own[at]:g}")
    for k, piece in enumerate(pieces):
        at = time[piece][np.isfinite(time[piece])]
        reason = "the time goes back" if np.any(np.diff(at) <= 0) else None
        for name in ("R", "C"):
            if reason is None and np.any(samples[name][piece] != samples[name][piece[0]]):
                reason = f"{name} changes"
        if reason is not None:
            bad.setdefault(k, reason)
            problems.append(f"{table.file}: {reason} in the breath of {table.place(int(piece[0]))}")
    if problems and (not skip or len(bad) == len(pieces)):
        some = len(bad) < len(pieces)
        problems.append(
            f"{len(bad)} of {len(pieces)} breaths are concerned"
            + ("; --skip-bad-breaths leaves them out." if some else ".")
        )
        raise InputError("\n".join([*problems[:5], *problems[5:][-1:]]))
    kept = [piece for k, piece in enumerate(pieces) if k not in bad]
    said = [f"{table.place(int(pieces[k][0]))} ({why})" for k, why in sorted(bad.items())]
    more = f" and {len(said) - 10} more" if len(said) > 10 else ""
    left = f"{len(said)} bad breaths were left out: {', '.join(said[:10])}{more}."
    return kept, [left] if said else []


def _suspicious(
    samples: Mapping[str, NDArray[Any]], changes: Mapping[str, Conversion]
) -> list[str]:
    """Sizes that look like a forgotten unit."""
    warnings = []
    for role, small, advice in (
        ("flow", _SMALL_FLOW, "--flow-unit L/min or L/s"),
        ("volume", _SMALL_VOLUME, "--volume-unit L"),
    ):
        if role in samples and np.isfinite(samples[role]).any():
            size = float(np.nanquantile(np.abs(samples[role]), 0.99))
            if size < small:
                warnings.append(
                    f"{role} is {size:.3g} {changes[role].to} at most (99 %), which is little; is "
                    f"the unit right ({advice})?"
                )
    return warnings


def _breaths(
    source: str,
    pieces: list[Ints],
    time: Floats,
    samples: Mapping[str, NDArray[Any]],
    R: Floats,
    C: Floats,
    notes: list[str],
) -> Breaths:
    rows, lengths = np.concatenate(pieces), np.array([len(piece) for piece in pieces])
    first = np.array([piece[0] for piece in pieces])
    parts = []
    for piece in pieces:
        at, k = time[piece], np.arange(len(piece))
        known = np.isfinite(at)
        at = np.interp(k, k[known], at[known]) if not known.all() else at
        parts.append(at - at[0])
    columns = {
        name: values[rows].astype(np.int8 if name == "u_out" else float)
        for name, values in samples.items()
    }
    return arranged(
        lengths,
        np.concatenate(parts),
        columns,
        breath_id=np.arange(1, len(pieces) + 1),
        R=R[first].astype(float),
        C=C[first].astype(float),
        source=source,
        notes=tuple(notes),
    )
