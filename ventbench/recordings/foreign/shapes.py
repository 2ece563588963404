"""Tables of other shapes as one row a sample: a row a measurement, or a list of samples a cell.

A long ("tidy") table names what was measured in one column and holds the value in another, as
databases of time series export it; a packed one has a row a breath or a message.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from ventbench.base.arrays import Floats, Pieces, Texts
from ventbench.base.errors import InputError
from ventbench.recordings.foreign.tables import Table, named, rate_of
from ventbench.recordings.headers import Conversion, conversion, is_unit

#: Names of the values of a long table, and most things that it measures.
_VALUES, _MOST = ("value", "values", "reading", "measurement", "val", "amplitude", "payload"), 100

#: Most channels of one quantity that a device has.
_CHANNELS = 32

#: Number of a sample in a header, which no letter follows as in units.
_PLACE = re.compile(r"[\s_.#-]*(?:[\[(]\d+[\])]|\d+(?![^\W_]))")

#: Seconds since 1970 that a recording may be of: 2001 to 2100.
_RECORDED = (1e9, 4.1e9)

#: Days since 1899 of 2000 to 2100, as spreadsheets count, and the step that tells days, which would
#: be 9 s, from other times, of which it is a rate of 10 kHz.
_SERIAL, _DAYS_STEP = (36526, 73050), 1e-4

#: Share of the steps between starts that must agree, and how well, to tell an interval.
_AGREEING, _ALIKE = 0.8, 0.02


def one_row_a_sample(
    table: Table, mapped: Texts, time_unit: str | None, rate: float | None
) -> Table:
    """Bring a long or a packed table into the usual shape; any other comes back as it is.

    Args:
        table: the table.
        mapped: role of each column that the user maps; of a long table also of what it measures.
        time_unit: unit of the time, where the user names it.
        rate: sampling rate, Hz, where the user names it.

    Raises:
        InputError: if lists of one row differ in length, or nothing tells the time within them.
    """
    table = _gathered(_pivoted(_with_units(table), mapped))
    return _unpacked(table, mapped, time_unit, rate)


def epoch_unit(values: Floats) -> str | None:
    """Unit in which a clock counts since 1970, or days since 1899, by its size; None if neither."""
    finite = np.asarray(values)[np.isfinite(values)]
    steps = np.abs(np.diff(finite))
    fine = np.any(steps > 0) and np.median(steps[steps > 0]) < _DAYS_STEP
    if fine and _SERIAL[0] <= finite.min() <= finite.max() <= _SERIAL[1]:
        return "day"
    for unit in ("s", "ms", "us", "ns"):
        seconds = conversion("time", unit).apply(finite)
        if len(finite) and _RECORDED[0] <= seconds.min() <= seconds.max() <= _RECORDED[1]:
            return unit
    return None


def change_of(table: Table, name: str, quantity: str, unit: str | None) -> Conversion:
    """Change of units of a column: as given, by its header, beside it; a clock's since 1970."""
    unit = unit or table.header(name).unit or table.units.get(name)
    if quantity == "time":
        unit = unit or epoch_unit(table.columns[name])
    return conversion(quantity, unit)


def _with_units(table: Table) -> Table:
    """The table with units that stand in a column beside: ``flow`` and ``flow_unit``."""
    units = {}
    for name, words in table.columns.items():
        what = re.sub(r"[\s_.]*units?$", "", name, flags=re.IGNORECASE)
        if what != name and words.dtype.kind == "U" and _units(np.unique(words).tolist()):
            units |= {n: str(words[0]) for n in table.columns if n in (what, f"{what}.value")}
    return replace(table, units=units | table.units)


def _role(table: Table, name: str, mapped: Texts) -> str | None:
    header = table.header(name)
    written = table.headers.get(name, name)
    return mapped.get(name) or mapped.get(written) or (header.role if header.certain else None)


def _clock(table: Table, mapped: Texts) -> str | None:
    """The column of numbers that is the time."""
    numeric = filter(table.is_numeric, table.columns)
    return next((name for name in numeric if _role(table, name, mapped) == "time"), None)


def _pivoted(table: Table, mapped: Texts) -> Table:
    """A column each of what a long table measures; a row each time, in the order of time."""
    numeric = list(filter(table.is_numeric, table.columns))
    if any(_role(table, name, mapped) == "pressure" for name in numeric):
        return table
    import pandas as pd  # which takes time and memory that most files do not need

    values = next((n for n in numeric if n.strip("_ ").casefold() in _VALUES), None)
    words = {
        name: [str(x) for x in pd.unique(x) if x]
        for name, x in table.columns.items()
        if x.dtype.kind == "U"
    }
    kinds = {name: x for name, x in words.items() if 1 <= len(x) <= _MOST and not _units(x)}
    if values is None or not kinds:
        return table

    def understood(name: str) -> tuple[int, int]:
        titles = Table("", {}, headers=named(kinds[name]))
        return sum(_role(titles, n, mapped) is not None for n in titles.headers), len(kinds[name])

    kind, time = max(kinds, key=understood), _clock(table, mapped)
    if understood(kind) < (0, 2):
        return table
    clock = np.zeros(len(table)) if time is None else table.columns[time]
    frame = pd.DataFrame({"kind": table.columns[kind], "clock": clock})
    frame["again"] = frame.groupby(["kind", "clock"], dropna=False).cumcount()
    onwards = bool(frame.groupby("kind")["clock"].is_monotonic_increasing.all())
    places = frame.groupby(["clock", "again"], sort=onwards, dropna=False)
    row = places.ngroup().to_numpy()
    first = np.unique(row, return_index=True)[1]
    unit_column = next((name for name, x in words.items() if _units(x)), None)
    headers, units = named(kinds[kind]), dict(table.units)
    wide = pd.Series(table.columns[values], [row, table.columns[kind]]).unstack()
    columns = {name: wide[written].to_numpy() for name, written in headers.items()}
    if unit_column is not None:
        of_kind = dict(zip(table.columns[kind], table.columns[unit_column], strict=True))
        units |= {name: str(of_kind[written]) for name, written in headers.items()}
    for name, x in table.columns.items():
        kept = name not in (kind, values, unit_column) and len(pd.unique(x)) > 1
        if kept and name not in columns and (x == x[first][row]).all():
            columns[name] = x[first]
            headers[name] = table.headers.get(name, name)
    note = f"A row a measurement: {kind} names it, {values} is its value ({', '.join(headers)})."
    shorter = table.rows(first).noted(note)
    return replace(shorter, columns=columns, units=units, headers=headers)


def _gathered(table: Table) -> Table:
    """Lists of samples in place of columns that number them: ``Paw[0]``, ``Paw[1]``, ...

    There are more of them than rows, or than a device has channels.
    """
    series: dict[str, list[str]] = {}
    for name in filter(table.is_numeric, table.columns):
        series.setdefault(_PLACE.sub(" ", table.headers.get(name, name)), []).append(name)
    titles = [
        base for base, x in series.items() if base.strip() and len(x) > min(len(table), _CHANNELS)
    ]
    for base, header in named(titles).items():
        names = series[header]
        lists = np.empty(len(table), object)
        lists[:] = list(np.stack([table.columns[name] for name in names], axis=1))
        columns = {n: x for n, x in table.columns.items() if n not in names} | {base: lists}
        table = replace(table, columns=columns, headers=table.headers | {base: header})
    return table


def _units(words: list[str]) -> bool:
    return bool(words) and all(map(is_unit, words))


def _unpacked(table: Table, mapped: Texts, time_unit: str | None, rate: float | None) -> Table:
    """A row each sample of the lists that stand in cells; their times go on from those of rows."""
    packed = {
        name: x
        for name, x in table.columns.items()
        if x.dtype.kind == "O" and _role(table, name, mapped) != "unused"
    }
    if not packed:
        return table
    sizes = {name: np.array([len(cell) for cell in x]) for name, x in packed.items()}
    lengths = np.maximum.reduce(list(sizes.values()))
    for name, size in sizes.items():
        if len(odd := np.flatnonzero((size != lengths) & (size > 0))):
            raise InputError(
                f"{table.file}, {table.place(int(odd[0]))}: column {name} lists {size[odd[0]]} "
                f"samples, another one {lengths[odd[0]]}; leave one out with --map {name}=unused"
            )
    rows = Pieces.of(lengths)
    unrolled = table.rows(rows.owner)
    columns = unrolled.columns
    for name, x in packed.items():
        filled = (
            cell if len(cell) else np.full(n, np.nan) for cell, n in zip(x, lengths, strict=True)
        )
        columns[name] = np.concatenate(list(filled))
    note = f"{len(lengths)} rows of lists, of {np.median(lengths):g} samples (median)."
    unrolled = unrolled.noted(note)
    if rate is not None or any(_role(table, name, mapped) == "time" for name in packed):
        return unrolled
    time = _clock(table, mapped)
    factor = 1.0 if time is None else float(change_of(table, time, "time", time_unit).factor)
    starts = None if time is None else factor * np.asarray(table.columns[time], float)
    interval = _interval(table, starts, lengths)
    if interval is None:
        raise InputError(
            f"{table.file}: lists of samples stand in the cells of {', '.join(packed)}, and no "
            "column tells their rate; give it with --rate HZ"
        )
    if starts is None:
        starts = np.cumsum(interval * lengths) - interval * lengths
    columns[time or "time"] = (starts[rows.owner] + interval[rows.owner] * rows.within) / factor
    return unrolled


def _interval(table: Table, starts: Floats | None, lengths: Floats) -> Floats | None:
    """Time between samples in each row, s: as a column says, the file, or the starts of rows."""
    for name in filter(table.is_numeric, table.columns):
        header, x = table.headers.get(name, name), np.asarray(table.columns[name], float)
        if (rate := rate_of(header, x, "s", certain=True)) is not None:
            return 1.0 / rate
    if table.rate:
        return np.full(len(lengths), 1.0 / table.rate)
    if starts is None or len(starts) < 3:
        return None
    each = np.diff(starts) / lengths[:-1]
    usual = float(np.median(each))
    alike = np.abs(each - usual) <= _ALIKE * abs(usual)
    return np.full(len(lengths), usual) if usual > 0 and alike.mean() >= _AGREEING else None
