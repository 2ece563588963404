"""Waveforms of another laboratory as breaths: columns, units, breaths, valves; and a report.

A continuous recording is split where inspirations begin: at the number of the breath, at the
command of a valve, at the flow, or at the pressure, whichever there is, in this order. Nothing is
resampled or smoothed.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Columns, Floats, Ints, Pieces, Texts
from ventbench.base.errors import InputError
from ventbench.base.text import few
from ventbench.recordings.bad_samples import (
    MEASURED,
    BadSamples,
    at_the_slowest,
    blanked,
    find_bad_samples,
    left_out,
    notable,
    repeated_rows,
)
from ventbench.recordings.breaths import Breaths, arranged
from ventbench.recordings.foreign.cycles import expiratory_valve, find_breaths, signed_flow
from ventbench.recordings.foreign.formats import read_table
from ventbench.recordings.foreign.layouts import LAYOUTS, ROLES, Layout, recognise
from ventbench.recordings.foreign.shapes import change_of, epoch_unit, one_row_a_sample
from ventbench.recordings.foreign.tables import Table
from ventbench.recordings.headers import (
    STATES,
    UNITS,
    USUAL,
    WRAPS,
    Conversion,
    conversion,
    read_header,
)
from ventbench.recordings.roles import SLOW, check_roles, few_breaths
from ventbench.recordings.scan import complete_times
from ventbench.recordings.schema import COLUMNS
from ventbench.task.lungs import lung as parse

#: Flows that a sensor counts in one direction.
_ONE_WAY = ("flow_in", "flow_out")

#: Pressure, cmH2O, from which it is absolute, and that of the air.
_ABSOLUTE, _AIR = 500.0, 1033.2275

#: Share of the steps of a clock that may be zero, and precision of a rate that it tells.
_STANDS_STILL, _PRECISE = 0.02, 0.005

#: Share of the median step of a clock that nearly all of its steps exceed.
_EVEN = 0.5


@dataclass(frozen=True, eq=False)
class Imported:
    """An imported recording."""

    breaths: Breaths  #: the breaths, in the units of the schema.
    conversions: Mapping[str, Conversion]  #: change of units by role.
    columns: Texts  #: role of each column of the file that is used.
    understood: tuple[str, ...]  #: what was understood, a sentence each.
    warnings: tuple[str, ...]  #: what may be wrong, a sentence each.
    bad: tuple[BadSamples, ...] = ()  #: samples that were left out, in the unit of the file.

    @property
    def preview(self) -> str:
        """The first rows as they are written."""
        return self.breaths[:1].to_frame().head(5).to_string(index=False)

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
            "left_out": [
                {
                    "column": samples.column,
                    "kind": samples.kind,
                    "count": len(samples.rows),
                    "share": samples.share,
                    "rows": (samples.rows[:1000] + 1).tolist(),
                }
                for samples in self.bad
            ],
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
    missing: Iterable[float] = (),
    words: Mapping[str, float] | None = None,
    skip_bad_breaths: bool = False,
    separator: str | None = None,
    decimal: str | None = None,
) -> Imported:
    """Read a recording of another laboratory.

    Args:
        path: text with any separator (also gzipped), JSON, a spreadsheet, Parquet, NumPy, MATLAB,
            EDF, BDF, the header (.hea) of a WFDB record, MCAP, or a bag of ROS; or what has been
            read of one. Its table has a row a sample, a row a measurement, or lists of samples.
        columns: role of each column, ``{"Paw": "pressure"}``; the roles are ``time``,
            ``pressure``, ``flow`` (or ``flow_in`` and ``flow_out``, one-way flows), ``volume``,
            ``u_in``, ``u_out``, ``R``, ``C``, ``breath``, ``group`` (a breath ends where it
            changes), ``target`` (inspiration is where it is high) and ``unused``. Columns whose
            headers are understood (see :mod:`.headers`) need none.
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
        missing: values that stand for a missing one, such as -99.
        words: numbers that words in cells stand for, ``{"high": 1, "low": 0}``; pairs such as open
            and closed are understood.
        skip_bad_breaths: leave out breaths that the schema cannot hold, and name them.
        separator: separator of the cells; found out if None.
        decimal: ``"."`` or ``","``; found out if None.

    Raises:
        InputError: if a column that is needed is missing or not understood, a unit is unknown,
            there is no breath, or columns are not what they are called.

    Example:
        >>> import ventbench
        >>> imported = ventbench.import_recording(
        ...     "lab.csv", columns={"Paw": "pressure"}, units={"flow": "L/min"}, lung="R20C50"
        ... )  # doctest: +SKIP
    """
    table = path
    if not isinstance(table, Table):
        table = read_table(table, separator=separator, decimal=decimal)
    table = _selected(table, dict(select or {}))
    mapped, units = dict(columns or {}), dict(units or {})
    table = one_row_a_sample(table, mapped, units.get("time"), rate)
    layout = layout or recognise(table.columns)
    spec = _layout(layout, table)
    roles = _roles(table, mapped, spec, rate)
    spoken = {x.casefold(): number for x, number in (spec.words | dict(words or {})).items()}
    table, roles = _states(table, roles, spoken)
    by_role = {role: name for name, role in roles.items() if role not in ("group", "unused")}
    changes = _conversions(table, by_role, units, spec)
    if spec.about:
        table = table.noted(f"Layout {layout}: {spec.about}.")
    table = _in_order(table, by_role)
    raw = {
        role: _numbers(table, name, spoken)
        for role, name in by_role.items()
        if role != "breath" and not (role == "time" and rate is not None)
    }
    table, raw = _without_repeats(table, raw)
    if "time" not in raw:
        raw["time"], changes["time"], how = _even(table, by_role, rate)
        table = table.noted(how)
    measured = {role: raw[role] for role in (*MEASURED, "u_in") if role in raw}
    schema = {role: changes[role].apply(x) for role, x in measured.items()}
    bad = find_bad_samples(measured, tuple(missing), schema)
    raw |= blanked(measured, bad)
    warnings = [_of_file(bad_samples, table, by_role) for bad_samples in bad]
    notes = list(table.notes)
    added = dict(offsets or {})
    if unknown := set(added) - set(raw):
        raise InputError(f"--offset {min(unknown)}: no column is {min(unknown)}")
    raw["time"], sentences = _continued(table, raw["time"])
    notes += sentences
    values = raw | {
        role: changes[role].apply(raw[role] + added[role] if role in added else raw[role])
        for role in changes.keys() & raw.keys()
    }
    del raw, measured, schema  # a copy of every column that is no longer needed
    if not np.isfinite(values["pressure"]).any():
        raise InputError(
            f"{table.file}, column {by_role['pressure']}: every pressure is blank, so there is "
            "nothing to compare a simulator with"
        )
    notes += _net_flow(table, values)
    for role in ("flow", "volume"):
        if role in values and not np.isfinite(values[role]).any():
            notes.append(f"Column {by_role.get(role, role)} is blank throughout.")
            del values[role]
    _invert(values, invert)
    warnings += _check_sizes(table, by_role, values, changes, USUAL if layout else units)
    keys = groups = [
        _labels(table.columns[name]) for name, role in roles.items() if role == "group"
    ]
    if "breath" in by_role and not split_breaths:
        keys = [*groups, _labels(table.columns[by_role["breath"]])]
    time = values["time"]
    notes += _checked_clock(table, time, keys)
    if "u_in" in values:
        values["u_in"], sentences = _held(values["u_in"], by_role["u_in"])
        notes += sentences
    unused = [name for name in table.columns if roles.get(name, "unused") == "unused"]
    unused += [by_role["time"]] if rate is not None and "time" in by_role else []
    if unused:
        notes.append(f"Columns that are not used: {', '.join(unused)}.")
    pieces, how = find_breaths(table.file, time, values, keys, groups, spec.lead)
    notes.append(how)
    R, C, how = _lung(lung, values, len(table))
    notes.append(how)
    u_out, how = expiratory_valve(values, pieces)
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
    samples = {"u_in": u_in, "u_out": u_out}
    samples |= {name: values[name] for name in MEASURED if name in values}
    labelled = {**samples, "R": R, "C": C}
    pieces, dropped = _sound(table, by_role, labelled, time, pieces, skip_bad_breaths)
    notes += dropped
    rows, parts = np.concatenate(pieces), Pieces.of(list(map(len, pieces)))
    breaths = arranged(
        parts.lengths,
        complete_times(time[rows], parts),
        {name: x[rows] for name, x in samples.items()},
        breath_id=np.arange(1, len(pieces) + 1),
        R=R[rows[parts.starts]],
        C=C[rows[parts.starts]],
        source=table.file,
        notes=tuple(notes),
        left_out=left_out(bad),
    )
    notable(breaths)
    breaths = breaths if "u_in" in values else at_the_slowest(breaths)
    doubts = check_roles(breaths)
    for doubt in doubts:
        if doubt.level == "refused":
            column = by_role.get(doubt.column, doubt.column)
            refusal = f"{table.file}, column {column}: {doubt}"
            raise InputError(refusal.replace("NAME", quote(column)))
    warnings += map(str, doubts)
    notes = [*breaths.notes, *few_breaths(len(breaths))]
    used = {name: role for name, role in roles.items() if role != "unused"}
    return Imported(breaths, changes, used, tuple(notes), tuple(warnings), bad)


def import_runs(path: str | Path) -> dict[str, Breaths]:
    """Read each recording of a Parquet file whose layout tells several apart.

    Errors are those of :func:`import_recording`.

    Returns:
        Breaths by the values of the columns that do, in the order of the file: of RespiraWorks by
        run and test, ``"2020-07-31-UFlow-Performance 4"``. Nothing of any other file.
    """
    import pandas as pd
    import pyarrow as pa
    from pyarrow import parquet

    try:
        layout = LAYOUTS.get(recognise(parquet.read_schema(path).names) or "")
    except (pa.ArrowException, OSError):
        return {}
    groups = [name for name, role in layout.columns.items() if role == "group"] if layout else []
    if not groups:
        return {}
    table = read_table(path)
    frame = pd.DataFrame({name: table.columns[name] for name in groups})
    return {
        " ".join(f"{x:g}" if isinstance(x, float) else x for x in key): import_recording(  # type: ignore[attr-defined]
            table.rows(run.index.to_numpy())
        ).breaths
        for key, run in frame.groupby(groups, sort=False)
    }


def _selected(table: Table, select: Texts) -> Table:
    """Rows whose columns have given values."""
    keep = np.ones(len(table), bool)
    for name, value in select.items():
        if name not in table.columns:
            raise InputError(
                f"--select {name}={value}: {table.file} has no column {name}; it has {table.names}"
            )
        keep &= table.columns[name] == (_number(value) if table.is_numeric(name) else value)
    if not keep.any():
        conditions = ", ".join(f"{n}={v}" for n, v in select.items())
        raise InputError(f"{table.file}: no row has {conditions}")
    if keep.all():
        return table
    return table.rows(keep).noted(f"{int(keep.sum())} of {len(keep)} rows were selected.")


def _number(word: str) -> float | None:
    """The number that a word is, NaN of a blank one; None if it is none."""
    try:
        return float(word or "nan")
    except ValueError:
        return None


def _layout(name: str | None, table: Table) -> Layout:
    if name is None:
        return Layout()
    if name not in LAYOUTS:
        raise InputError(f"--layout {name}: choose one of {', '.join(LAYOUTS)}")
    missing = [c for c in LAYOUTS[name].required if c not in table.columns]
    if missing:
        raise InputError(
            f"{table.file} is not of layout {name}: it has no column {', '.join(missing)}"
        )
    return LAYOUTS[name]


def _roles(table: Table, mapped: Texts, layout: Layout, rate: float | None) -> Texts:
    """Role of each column: as mapped, by the layout, by its header; the first of each role."""
    roles = _mapped(table, mapped)
    assigned = {role for role in roles.values() if role not in ("group", "unused")}
    candidates: dict[str, list[str]] = {}
    for name in table.columns:
        if name in roles:
            continue
        if layout.columns:
            role = layout.columns.get(name)
        else:
            header = table.header(name)
            role = header.role if header.certain else None
            role = f"{role}_{header.side}" if role and header.side else role
        if role in ("group", "unused"):
            roles[name] = role
        elif role is not None and role not in assigned:
            candidates.setdefault(role, []).append(name)
    single = set(_ONE_WAY) & (candidates.keys() | assigned)
    if "flow" in candidates.keys() | assigned or len(single) == 1:
        for role in single:
            candidates.pop(role, None)
    for role, names in candidates.items():
        _check_duplicates(table, role, names)
        roles[names[0]] = role
    for role in set(roles.values()) - {"group", "unused"}:
        names = [name for name, assigned_role in roles.items() if assigned_role == role]
        if len(names) > 1:
            raise InputError(f"columns {' and '.join(names)} are both {role}; map one of them")
    _check_needed(table, roles, layout, rate)
    return roles


def _mapped(table: Table, mapped: Texts) -> Texts:
    """Roles of columns that a user maps, by their names in the table."""
    headers = {text: name for name, text in table.headers.items()}
    roles = {}
    for header, role in mapped.items():
        name = header if header in table.columns else headers.get(header, read_header(header).name)
        if role not in ROLES:
            raise InputError(f"--map {header}={role}: a column may be {', '.join(ROLES)}")
        if name not in table.columns:
            close = get_close_matches(header, table.columns, n=1)
            hint = f" Perhaps {close[0]!r}." if close else ""
            raise InputError(
                f"--map {header}={role}: {table.file} has no column {header!r}; it has "
                f"{table.names}.{hint}"
            )
        roles[name] = role
    return roles


#: Roles one of which a file needs, and what they are in words.
_NEEDED = {
    "the pressure": ("pressure",),
    "the time": ("time",),
    "the flow, the volume or the command of a valve": ("flow", "flow_in", "volume", "u_in"),
}


def _check_needed(table: Table, roles: Texts, layout: Layout, rate: float | None) -> None:
    """Ask for a column that is needed and not understood, with the option that says it."""
    if set(table.columns) == {"id", "pressure"}:  # as the competition's submissions
        raise InputError(
            f"{table.file} holds pressures by row alone, as a submission does; diagnose the "
            f"recording with --simulator {table.file}"
        )
    has = set(roles.values())
    timed = rate or table.rate or any(table.header(name).interval for name in table.columns)
    for quantity, accepted in _NEEDED.items():
        is_time = accepted[0] == "time"
        if has & set(accepted) or (is_time and timed):
            continue
        others = (name for name in table.columns if name not in roles)
        headers = {name: table.header(name) for name in filter(table.is_numeric, others)}
        likely = [name for name, header in headers.items() if header.role in accepted]
        open_ = likely or [name for name, x in headers.items() if not (x.role or x.excluded)]
        if len(accepted) > 1 and (not open_ or layout.columns):
            continue
        back = {name: (np.diff(table.columns[name]) < 0).sum() > len(table) // 10 for name in open_}
        open_.sort(key=lambda name: back[name] == is_time)
        columns = f"{table.file}: no column is {quantity}; the columns are {table.names}"
        role = next((headers[n].role for n in likely), None) or accepted[0]
        option = f"--map {quote([*open_, *headers, 'NAME'][0])}={role}"
        if is_time:
            raise InputError(
                f"{columns}. Say which with {option}, or give the sampling rate with --rate HZ"
            )
        remedy = ""
        if len(accepted) > 1:
            exclusions = " ".join(f"--map {quote(name)}=unused" for name in open_)
            remedy = f"; or, if none of them is, {exclusions}"
        raise InputError(f"{columns}. Say which with {option}{remedy}")


def _check_duplicates(table: Table, role: str, names: Sequence[str]) -> None:
    """Refuse to choose among columns of one role that differ."""
    if role not in UNITS or role == "time":
        return
    first = table.columns[names[0]]
    for name in names[1:]:
        second = table.columns[name]
        if not (table.is_numeric(names[0]) and table.is_numeric(name)):
            continue
        apart = np.abs(np.asarray(first, float) - np.asarray(second, float))
        if np.isfinite(apart).any() and np.nanmax(apart) > 1e-9 * np.nanmax(np.abs(first)):
            raise InputError(
                f"{table.file}: columns {names[0]} and {name} may both be {role}, and differ by "
                f"{np.nanmedian(apart):.3g} (median); say which with --map {name}={role}, or give "
                f"--map {name}=unused"
            )


def _conversions(
    table: Table, by_role: Texts, units: Texts, layout: Layout
) -> dict[str, Conversion]:
    for role in units:
        if role not in UNITS:
            raise InputError(f"{role} has no unit; units are for {', '.join(UNITS)}")
    quantities = {role: role for role in UNITS} | dict.fromkeys(_ONE_WAY, "flow")
    given = layout.units | units
    return {
        role: change_of(table, name, quantities[role], given.get(quantities[role]))
        for role, name in by_role.items()
        if role in quantities
    }


def _states(table: Table, roles: Texts, spoken: dict[str, float]) -> tuple[Table, Texts]:
    """Add a pair of words such as open and closed in the columns of valves to those with numbers.

    A column of inspiration and expiration is that of the expiratory valve if there is no other.
    """
    units, roles, sentences = dict(table.units), dict(roles), []
    for name, values in table.columns.items():
        if values.dtype.kind != "U" or roles.get(name, "u_out") not in ("u_in", "u_out"):
            continue
        words = {word.casefold(): word for word in np.unique(values).tolist() if word}
        state = STATES.get(frozenset(words))
        if state is None or words.keys() <= spoken.keys():
            continue
        if name not in roles and not (state.phase and "u_out" not in roles.values()):
            continue
        one, zero = state.one, state.zero
        if roles.setdefault(name, "u_out") == "u_in":
            one, zero = (zero, one) if state.phase else (one, zero)
            units[name] = "1"
        spoken |= {one: 1.0, zero: 0.0}
        sentences.append(
            f"{name}: {words[one]} is 1 (open) and {words[zero]} is 0; else give --map-values."
        )
    return replace(table, units=units).noted(*sentences), roles


def _numbers(table: Table, name: str, spoken: Mapping[str, float]) -> Floats:
    """Numbers of a column, in which words may stand for some."""
    values = table.columns[name]
    if table.is_numeric(name):
        return np.asarray(values, float)
    kinds, which = np.unique(values.astype(str), return_inverse=True)
    numbers = [spoken.get(word.casefold(), _number(word)) for word in kinds.tolist()]
    if None in numbers:
        examples = [str(x) for x in dict.fromkeys(values.tolist()) if x][:2]
        examples.sort(key=lambda x: not re.match("open|on|true|yes|hi|1", x, re.IGNORECASE))
        option = ",".join(f"{x}={1 - n}" for n, x in enumerate(examples))
        raise InputError(
            f"{table.file}, column {name}: its cells are no numbers, such as {examples[0]!r}; say "
            f"what they stand for, such as --map-values {quote(option)}"
        )
    return np.array(numbers, float)[which.reshape(-1)]


def _in_order(table: Table, by_role: Texts) -> Table:
    """Rows from the oldest to the newest; notes what a clock counts by its size.

    Rows out of order are sorted if their times, by breaths where these are numbered, are then even:
    those of a clock that begins anew are not.
    """
    clock = by_role.get("time")
    if clock is None or not table.is_numeric(clock):
        return table
    if (unit := epoch_unit(table.columns[clock])) not in (None, "s"):
        since = {"day": 1899}.get(unit, 1970)
        table = table.noted(f"{clock} counts {unit} since {since}, by the size of its values.")
    keys = [table.columns[by_role[role]] for role in ("time", "breath") if role in by_role]
    steps = np.diff(keys[0])
    if (steps < 0).sum() > max(3, len(table) // 1000):
        order = np.lexsort(keys)
        after = np.abs(np.diff(keys[0][order]))
        even = np.quantile(after, 0.1) > _EVEN * np.median(after)
        if even and (np.diff(order) != 1).any():
            return table.rows(order).noted("Rows were put in the order of time.")
    if np.nansum(np.sign(steps)) >= 0:
        return table
    backwards = table.rows(np.arange(len(table))[::-1])
    return backwards.noted("The newest row comes first: rows were put in the order of time.")


def _without_repeats(table: Table, raw: Columns) -> tuple[Table, Columns]:
    """Leave out rows that are there twice, and say which."""
    omitted = repeated_rows(raw)
    if not omitted.any():
        return table, raw
    first = table.place(int(np.argmax(omitted)))
    sentence = f"{omitted.sum()} rows that repeat the row before were left out, the first in "
    table = table.rows(~omitted).noted(f"{sentence}{first}.")
    return table, {role: x[~omitted] for role, x in raw.items()}


def _of_file(bad: BadSamples, table: Table, by_role: Texts) -> str:
    """What was left out, by the name and the lines of the file."""
    lines = np.arange(1, len(table) + 1) if table.lines is None else table.lines
    text = bad.what("rows" if table.lines is None else "lines", lines[bad.rows[:6]].tolist())
    return text.replace(f"of {bad.column} ", f"of {by_role[bad.column]} ", 1) + "."


def _labels(values: NDArray[Any]) -> Ints:
    """Number of each distinct value."""
    return np.unique(values, return_inverse=True)[1].reshape(-1)


def _net_flow(table: Table, values: Columns) -> list[str]:
    """Replace two one-way flows by their difference, and a flow without a sign; a note."""
    if "flow_in" in values:
        out = values.pop("flow_out")
        outward = np.copysign(1.0, np.nanmean(out))
        values["flow"] = values.pop("flow_in") - outward * out
    flow = values.get("flow")
    if flow is None or not np.isfinite(flow).any():
        return []
    signed = signed_flow(table.file, values["time"], values["pressure"], flow)
    if signed is None:
        return []
    values["flow"] = signed
    return ["Flow has no sign: it was turned outwards as pressure falls."]


def _continued(table: Table, time: Floats) -> tuple[Floats, list[str]]:
    """Times, in the unit of the file, continued over the wraps of a counter; and where it jumps."""
    at = np.flatnonzero(np.isfinite(time))
    steps = np.diff(time[at])
    back = np.flatnonzero(steps < 0)
    if len(back) == 0 or not (steps > 0).any():
        return time, []
    usual, time, wraps, resets = float(np.median(steps[steps > 0])), time.copy(), [], []
    for k in back.tolist():
        size = next((w for w in WRAPS if 0.0 < steps[k] + w <= 2.5 * usual), None)
        place = table.place(int(at[k + 1]))
        if size is None:
            resets.append(place)
        else:
            wraps.append(f"{place} (at {size:.10g})")
            time[at[k + 1] :] += size
    sentences = []
    if wraps:
        sentences.append(f"The clock wraps in {few(wraps)}; it was continued.")
    if resets and len(resets) <= max(3, len(time) // 1000):
        sentences.append(f"The clock begins anew in {few(resets)}; no breath goes on over that.")
    return time, sentences


def _held(u_in: Floats, name: str) -> tuple[Floats, list[str]]:
    """Commands, each held until the next one where they come more slowly than the rows; a note."""
    rows, at = np.arange(len(u_in)), np.flatnonzero(np.isfinite(u_in))
    if len(at) < 2 or len(at) == len(rows):
        return u_in, []
    last, every = at[np.searchsorted(at, rows, side="right") - 1], float(np.median(np.diff(at)))
    held = (rows >= last) & (rows - last < 2.0 * every)
    sentence = f"{name} is known in one of {every:g} rows; it was held."
    return np.where(held, u_in[last], np.nan), [sentence] if every > 1.0 else []


def _even(table: Table, by_role: Texts, rate: float | None) -> tuple[Floats, Conversion, str]:
    """Times of rows at an even rate, s, and what they are, where no clock is used."""
    stated = next(filter(None, (table.header(n).interval for n in by_role.values())), None)
    hertz = rate if rate is not None else table.rate or 1.0 / (stated or np.nan)
    if hertz <= 0:
        raise InputError(f"--rate {hertz:g}: a positive rate in Hz is needed")
    origin = (
        "of the file" if rate is None else "as given (C is too small by the share of lost rows)"
    )
    how = f"Sampling rate {hertz:g} Hz, {origin}."
    return np.arange(len(table)) / hertz, conversion("time", None), how


def _checked_clock(table: Table, time: Floats, keys: list[Ints]) -> list[str]:
    """Refuse a clock, s, that is too coarse or of another unit; what it is in words."""
    steps = np.diff(time)
    inside = np.isfinite(steps)
    for key in keys:
        inside &= np.diff(key) == 0
    if not inside.any():
        return ["Times are blank in part."]
    onwards = steps[inside & (steps > 0)]
    if len(onwards) == 0:
        raise InputError(f"{table.file}: the time does not increase; give --rate in its place")
    median = float(np.median(onwards))
    if (steps[inside] == 0).mean() > _STANDS_STILL:
        forward = inside & (steps >= 0) & (steps <= 5.0 * median)
        rows, seconds = int(forward.sum()), float(steps[forward].sum())
        advice = "the sampling rate with --rate, which such a clock does not tell"
        if median / seconds < _PRECISE:
            advice = f"the sampling rate, such as --rate {_plain(rows / seconds, median / seconds)}"
        raise InputError(
            f"{table.file}: the clock has steps of {1e3 * median:.4g} ms for "
            f"{rows * median / seconds:.3g} rows each; give {advice}"
        )
    if median > SLOW:
        raise InputError(
            f"{table.file}: the median sampling interval is {median:.4g} s, and rates are 20 to "
            "1000 Hz; give --time-unit ms, or the sampling rate with --rate HZ"
        )
    return [f"Sampling interval {1e3 * median:.4g} ms (median), {1 / median:.4g} Hz."]


def _plain(rate: float, precision: float) -> str:
    """The roundest number within the precision of a rate."""
    digits = next(d for d in range(1, 12) if abs(float(f"{rate:.{d}g}") / rate - 1.0) < precision)
    return f"{float(f'{rate:.{digits}g}'):g}"


def _lung(label_id: str | None, values: Columns, count: int) -> tuple[Floats, Floats, str]:
    """R and C of each row."""
    if label_id is not None:
        label = parse(label_id)
        over = " in place of R and C of the file" if {"R", "C"} <= values.keys() else ""
        how = f"Lung {label.id}, as given{over}."
        return np.full(count, label.R), np.full(count, label.C), how
    if {"R", "C"} <= values.keys():
        pairs = np.unique(np.stack([values["R"], values["C"]], axis=1), axis=0)
        ids = ", ".join(f"R{R:g}C{C:g}" for R, C in pairs[:9].tolist())
        return values["R"], values["C"], f"Lungs of the file: {ids}."
    raise InputError(
        "no columns hold R and C of the lung; give --lung R20C50 (a guess is enough: R in "
        "cmH2O/(L/s) and C in mL/cmH2O are fitted again), or map the columns"
    )


def _invert(values: Columns, roles: Iterable[str]) -> None:
    """Change signs; of a valve, what is open."""
    open_at = {"u_in": 100.0, "u_out": 1.0}
    for role in roles:
        if role not in values or role not in (*UNITS, "u_out"):
            raise InputError(f"--invert {role}: no column is {role}")
        values[role] = open_at.get(role, 0.0) - values[role]


def _check_sizes(
    table: Table,
    by_role: Texts,
    values: Columns,
    changes: Mapping[str, Conversion],
    given: Collection[str],
) -> Iterator[str]:
    """Refuse absolute pressure, and sizes that no ventilator's are but would be in another unit.

    Where the unit of a role is ``given`` by the user, that is only told.
    """
    for role, (least, most, units) in USUAL.items():
        if role not in values:
            continue
        change = changes.get(role) or changes["flow_in"]
        column, option = f"{table.file}, column {by_role.get(role, role)}", f"--{role}-unit"
        median, size = np.nanquantile(np.abs(values[role]), [0.5, 0.99]).tolist()
        if role == "pressure" and median > _ABSOLUTE:
            raise InputError(
                f"{column}: pressure is {median:.4g} cmH2O in the median, so "
                f"it is absolute; subtract that of the air, in {change.unit}: "
                f"--offset pressure=-{_AIR / change.factor:.6g}"
            )
        sizes = {x: size * float(conversion(role, x).factor / change.factor) for x in units}
        likely = [unit for unit, other in sizes.items() if least <= other <= most]
        if least <= size <= most or not likely:
            continue
        message = f"{role} is {size:.3g} {change.to} at most (99 %), which is no ventilator's"
        if role not in given:
            raise InputError(
                f"{column}: {message}; give {option} {likely[0]} ({sizes[likely[0]]:.3g} "
                f"{change.to}), or {option} {change.unit} if that is right"
            )
        yield f"{message}. Is it in {likely[0]} ({option})?"


def _sound(
    table: Table,
    by_role: Texts,
    samples: Columns,
    time: Floats,
    pieces: list[Ints],
    skip: bool,
) -> tuple[list[Ints], list[str]]:
    """Breaths that the schema can hold; refuse the others, or leave them out and name them."""
    rows, bad, problems = np.concatenate(pieces), dict[int, str](), list[str]()
    owner = Pieces.of(list(map(len, pieces))).owner
    for name, values in samples.items():
        column, cells = COLUMNS[name], np.asarray(values, float)[rows]
        wrong = np.flatnonzero(column.outside(cells) | (np.isnan(cells) & (not column.blank)))
        if len(wrong):
            problems.append(
                f"{table.file}, column {by_role.get(name, name)}: {len(wrong)} of {len(cells)} "
                f"values are outside {column.span}, the first in "
                f"{table.place(int(rows[wrong[0]]))} ({cells[wrong[0]]:g}). Check the unit "
                "(such as --flow-unit L/min) and the map."
            )
        for at in wrong[np.unique(owner[wrong], return_index=True)[1]]:
            bad.setdefault(int(owner[at]), f"{name} is {cells[at]:g}")
    for k, piece in enumerate(pieces):
        at = time[piece][np.isfinite(time[piece])]
        reason = "the time stands still or goes back" if np.any(np.diff(at) <= 0) else None
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
            + (
                "; --skip-bad-breaths leaves them out."
                if some
                else "; where rows are even, --rate HZ takes the place of such a time."
            )
        )
        raise InputError("\n".join([*problems[:5], *problems[5:][-1:]]))
    intact = [piece for k, piece in enumerate(pieces) if k not in bad]
    reasons = [f"{table.place(int(pieces[k][0]))} ({why})" for k, why in sorted(bad.items())]
    sentence = f"{len(reasons)} bad breaths were left out: {few(reasons, 10)}."
    return intact, [sentence] if reasons else []
