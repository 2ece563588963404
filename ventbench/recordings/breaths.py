"""Breaths in memory: n breaths of T samples as numpy arrays; to make, pad, join and write them."""

from __future__ import annotations

import gzip
import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Bools, Columns, Floats, Ints
from ventbench.base.errors import InputError, require
from ventbench.base.files import write_atomically
from ventbench.recordings.schema import COLUMNS, OPTIONAL
from ventbench.task.lungs import Lung

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Breaths:
    """n breaths of T samples; the arrays are read-only.

    Padding (`valid` False) follows a short breath: u_in is 0, u_out 1, pressure, flow and volume
    NaN, and time continues at the last interval.
    """

    breath_id: Ints  #: int64, (n,).
    R: Floats  #: resistance, cmH2O/(L/s), float64, (n,).
    C: Floats  #: compliance, mL/cmH2O, float64, (n,).
    time: Floats  #: s from each breath's first sample, float64, (n, T).
    #: s, `dt[:, i] = time[:, i+1] - time[:, i]`, the last repeated, float64, (n, T).
    dt: Floats
    u_in: Floats  #: opening of the inspiratory valve, %, float64, (n, T).
    u_out: np.ndarray  #: 1 while the expiratory valve is open, int8, (n, T).
    pressure: Floats  #: cmH2O, NaN where blank, float64, (n, T).
    valid: Bools  #: True for a sample, False for padding, bool, (n, T).
    #: True if a breath's times were blank and are an estimate, bool, (n,).
    time_inferred: Bools
    flow: Floats | None = None  #: mL/s, NaN where blank, float64, (n, T), or None.
    volume: Floats | None = None  #: mL, NaN where blank, float64, (n, T), or None.
    source: str | None = None  #: path of the file, or None.
    #: SHA-256 of the file, hex, or None if the breaths are not those of a whole file.
    sha256: str | None = None
    notes: tuple[str, ...] = ()  #: what a reader of the file should know, a sentence each.
    #: share of the readings of a column that are none and were left out, by column.
    left_out: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in self._arrays().values():
            array.setflags(write=False)

    def __len__(self) -> int:
        """Number of breaths n."""
        return len(self.breath_id)

    def __repr__(self) -> str:
        """Sizes and origin."""
        n, samples = self.pressure.shape
        lungs = len(self.by_lung_index)
        return f"Breaths({n} breaths x {samples} samples, {lungs} lungs, source={self.source!r})"

    def _repr_html_(self) -> str:
        """Return sizes, origin and notes, and a row a lung, as a notebook shows them."""
        import pandas as pd

        rows = {
            name: {
                "breaths": len(index),
                "interval, ms": 1e3 * float(np.median(self.dt[index][self.valid[index]])),
                "highest, cmH2O": float(np.fmax.reduce(self.pressure[index], axis=None)),
                "lowest, cmH2O": float(np.fmin.reduce(self.pressure[index], axis=None)),
                "u_in up to, %": float(self.u_in[index].max()),
            }
            for name, index in self.by_lung_index.items()
        }
        table = pd.DataFrame.from_dict(rows, orient="index").to_html(float_format="%.1f")
        paragraphs = (repr(self), *self.notes)
        return "".join(f"<p>{html.escape(text)}</p>" for text in paragraphs) + table

    def __getitem__(self, which: int | str | slice | list[int] | np.ndarray) -> Breaths:
        """Return some breaths: by place, slice, mask, places, or the id of a lung.

        Raises:
            IndexError: if there is no such breath.
            KeyError: if there is no breath of that lung.
        """
        if isinstance(which, str):
            if which not in self.by_lung_index:
                raise KeyError(f"no breath of lung {which}; there are {', '.join(self.by_lung())}")
            return self.select(self.by_lung_index[which])
        return self.select([which] if isinstance(which, int | np.integer) else which)

    def to_frame(self) -> pd.DataFrame:
        """One row a sample in the public schema, which :func:`ventbench.load_recording` takes."""
        import pandas as pd

        return pd.DataFrame(self.columns())

    def columns(self) -> Columns:
        """Columns of the public schema, one value a sample; NaN for times that were inferred."""
        lengths = self.valid.sum(axis=1)
        time = np.where(self.time_inferred[:, None], np.nan, self.time)
        columns = {"id": np.arange(1, 1 + int(lengths.sum()))}
        columns |= {
            name: np.repeat(getattr(self, name), lengths) for name in ("breath_id", "R", "C")
        }
        signals = {name: getattr(self, name) for name in ("u_in", "u_out", "pressure", *OPTIONAL)}
        signals = {"time_step": time} | signals
        return columns | {k: x[self.valid] for k, x in signals.items() if x is not None}

    def plot(self) -> Figure:
        """Draw pressure and commands of all breaths, a column a lung, as a matplotlib figure.

        Raises:
            InputError: if the extra ``ventbench[view]`` is missing.
        """
        require("matplotlib")
        from matplotlib.figure import Figure

        columns = self.by_lung_index
        figure = Figure(figsize=(3.0 + 2.2 * len(columns), 4.0), layout="constrained")
        axes = figure.subplots(2, len(columns), sharex=True, sharey="row", squeeze=False)
        names = ("airway pressure, cmH2O", "u_in, %")
        for row, (name, values) in enumerate(zip(names, (self.pressure, self.u_in), strict=True)):
            axes[row, 0].set_ylabel(name)
            for axis, index in zip(axes[row], columns.values(), strict=True):
                there = np.where(self.valid[index], values[index], np.nan)
                axis.plot(self.time[index].T, there.T, color="#1f5aa6", lw=0.8, alpha=0.5)
        for axis, (name, index) in zip(axes[0], columns.items(), strict=True):
            axis.set_title(f"{name}, {len(index)} breaths", fontsize="small")
        figure.supxlabel("time in the breath, s")
        return figure

    @cached_property
    def lung_ids(self) -> np.ndarray:
        """The lung of each breath, such as `R5C10`, str, (n,)."""
        pairs = zip(self.R.tolist(), self.C.tolist(), strict=True)
        return np.array([Lung(r, c).id for r, c in pairs], dtype=str)

    @cached_property
    def by_lung_index(self) -> dict[str, Ints]:
        """Indices of the breaths of each lung, int64, by R then C."""
        order = np.lexsort((self.C, self.R))
        names = dict.fromkeys(self.lung_ids[order].tolist())
        return {name: np.flatnonzero(self.lung_ids == name) for name in names}

    @cached_property
    def inspiratory(self) -> Bools:
        """Samples of inspiration: u_out is 0 and valid, bool, (n, T)."""
        mask = (self.u_out == 0) & self.valid
        mask.setflags(write=False)
        return mask

    def select(self, which: np.ndarray | slice | list[int]) -> Breaths:
        """Return some of the breaths, as copies; `source` and `sha256` still name their file.

        Args:
            which: a mask (n,), indices (k,) in any order, or a slice.

        Raises:
            IndexError: if an index is out of range, or the mask has another length.
        """
        index = which if isinstance(which, slice) else np.asarray(which)
        if isinstance(index, np.ndarray) and index.size == 0 and index.dtype != bool:
            index = index.astype(np.int64)
        chosen = {name: array[index].copy() for name, array in self._arrays().items()}
        return replace(self, **chosen)

    def by_lung(self) -> dict[str, Breaths]:
        """Return the breaths of each lung, by R then C."""
        return {name: self.select(index) for name, index in self.by_lung_index.items()}

    def _arrays(self) -> Columns:
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


#: How the names of recordings end.
SUFFIXES = (".csv", ".csv.gz", ".parquet", ".pq")

FILL = {"u_in": 0.0, "u_out": 1, "pressure": np.nan, "flow": np.nan, "volume": np.nan}
"""Values of padding."""


def stack(values: np.ndarray, lengths: Ints, fill: float, width: int | None = None) -> np.ndarray:
    """Arrange samples (m,) of consecutive breaths of lengths (n,) in rows, (n, T).

    A value fills short breaths. T is the width, or the longest length; a view if all lengths are T.
    """
    valid = valid_mask(lengths, width)
    if valid.all():
        return values.reshape(valid.shape)
    out = np.full(valid.shape, fill, dtype=values.dtype)
    out[valid] = values
    return out


def stack_times(time: Floats, lengths: Ints, width: int | None = None) -> tuple[Floats, Floats]:
    """Times, s, (m,) in rows, and intervals, each (n, T); lengths of at least 2, as of `stack`.

    In padding, time continues at the last interval.
    """
    padded = stack(time, lengths, np.nan, width)
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


def valid_mask(lengths: Ints, width: int | None = None) -> Bools:
    """True for samples, False for padding, (n, T)."""
    width = int(lengths.max(initial=0)) if width is None else width
    return np.arange(width) < lengths[:, None]


def arranged(
    lengths: Ints,
    time: Floats,
    samples: Columns,
    width: int | None = None,
    **rest: Any,
) -> Breaths:
    """Make breaths of consecutive samples; short ones are padded.

    Args:
        lengths: samples of each breath, at least 2, (n,), summing to m.
        time: s from the first sample of each breath, (m,).
        samples: `u_in`, `u_out`, `pressure` and perhaps `flow` and `volume`, (m,) each.
        width: T; the longest length if not given.
        rest: other fields of `Breaths`.
    """
    times, dt = stack_times(time, lengths, width)
    rows = {name: stack(values, lengths, FILL[name], width) for name, values in samples.items()}
    rest = {"time_inferred": np.zeros(len(lengths), bool)} | rest
    return Breaths(time=times, dt=dt, valid=valid_mask(lengths, width), **rows, **rest)


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

    Arguments have the units and shapes of the attributes of :class:`Breaths`, and are copied. All
    samples are valid.

    Raises:
        ValueError: if shapes differ, an id occurs twice, or time does not start at 0 and increase.
    """
    ids = np.array(breath_id, dtype=np.int64)
    times = np.array(time, dtype=np.float64)
    if times.ndim != 2 or times.shape[1] < 2:
        raise ValueError(f"time has shape {times.shape}, but (n, T) with T >= 2 is needed")
    if len(np.unique(ids)) != len(ids):
        raise ValueError("breath_id holds the same id twice; give each breath its own")
    if (times[:, 0] != 0.0).any() or not (np.diff(times, axis=1) > 0.0).all():
        raise ValueError("time must start at 0 in each breath and increase")
    labels = {"R": np.array(R, np.float64), "C": np.array(C, np.float64), "breath_id": ids}
    signals = {"u_in": u_in, "u_out": u_out, "pressure": pressure, "flow": flow, "volume": volume}
    samples = {
        name: np.array(values, np.int8 if name == "u_out" else np.float64)
        for name, values in signals.items()
        if values is not None
    }
    for name, array in (labels | samples).items():
        shape = times.shape if name in samples else times.shape[:1]
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, but {shape} is needed")
    flat = {name: array.ravel() for name, array in samples.items()}
    return arranged(np.full(len(ids), times.shape[1]), times.ravel(), flat, **labels)


def join(parts: Sequence[Breaths]) -> Breaths:
    """Join recordings; short breaths are padded, and ids may occur twice.

    Flow and volume are kept where all have them; ``source`` and ``sha256`` are left out.

    Raises:
        InputError: if there is nothing to join.
    """
    if not parts:
        raise InputError("there are no recordings to join")

    rest: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("breath_id", "R", "C", "time_inferred")
    }
    samples = {
        name: np.concatenate([getattr(part, name)[part.valid] for part in parts])
        for name in ("time", "u_in", "u_out", "pressure", *OPTIONAL)
        if all(getattr(part, name) is not None for part in parts)
    }
    sizes = np.array([part.valid.sum() for part in parts])
    shares = {
        name: float(np.average([each.left_out.get(name, 0.0) for each in parts], weights=sizes))
        for part in parts
        for name in part.left_out
    }
    return arranged(
        np.concatenate([part.valid.sum(axis=1) for part in parts]),
        samples.pop("time"),
        samples,
        notes=tuple(note for part in parts for note in part.notes),
        left_out=shares,
        **rest,
    )


def write(breaths: Breaths, path: str | os.PathLike[str]) -> None:
    """Write breaths to CSV, gzipped CSV or Parquet, by the ending of the name.

    Numbers read back exactly. Padding is left out; NaN is written blank. The same breaths give the
    same bytes. An existing file is replaced, a missing folder made. Inferred times are written
    blank, as they were read, so that nobody takes them for measurements.

    Raises:
        InputError: if there are no breaths, or the name has another ending.
        OSError: if the file cannot be written.
    """
    name = str(path)
    if len(breaths) == 0:
        raise InputError(f"{name}: there are no breaths to write")
    if not name.endswith(SUFFIXES):
        raise InputError(f"{name}: the name must end in .csv, .csv.gz, .parquet or .pq")
    table = _table(breaths)
    form = _write_parquet if name.endswith((".parquet", ".pq")) else _write_csv
    form = _write_packed if name.endswith(".gz") else form
    write_atomically(Path(path), lambda out: form(table, out))


def _write_parquet(table: pa.Table, stream: IO[bytes]) -> None:
    from pyarrow import parquet

    parquet.write_table(table, stream, compression="zstd")


def _write_csv(table: pa.Table, stream: IO[bytes]) -> None:
    from pyarrow import csv

    stream.write((",".join(table.column_names) + "\n").encode())
    csv.write_csv(table, stream, csv.WriteOptions(include_header=False))


def _write_packed(table: pa.Table, stream: IO[bytes]) -> None:
    with gzip.GzipFile("", "wb", compresslevel=6, fileobj=stream, mtime=0) as packed:
        _write_csv(table, cast("IO[bytes]", packed))


def _table(breaths: Breaths) -> pa.Table:
    """Columns of the schema with their units; labels that are whole numbers are written as such."""
    import pyarrow as pa

    columns = breaths.columns()
    kinds = {"id": pa.int64(), "breath_id": pa.int64(), "u_out": pa.int8()}
    for name in ("R", "C"):
        if (columns[name] == np.round(columns[name])).all():
            kinds[name] = pa.int64()
    fields = [
        pa.field(name, kinds.get(name, pa.float64()), metadata={"unit": COLUMNS[name].unit})
        for name in COLUMNS
        if name in columns
    ]
    arrays = [pa.array(columns[field.name], from_pandas=True).cast(field.type) for field in fields]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))
