"""Tables of simulated pressures beside the recorded ones, matched breath by breath."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths

#: Names of the column of simulated pressures, in the order in which they are looked for.
COLUMNS = ("simulated", "simulated_pressure", "pressure_simulated", "pressure")

#: Names of the column of times.
_TIMES = ("time_step", "time")


def read_simulated(path: str | os.PathLike[str], breaths: Breaths) -> NDArray[np.float64]:
    """Read simulated pressures of recorded breaths.

    The table has ``breath_id`` and a column of :data:`COLUMNS` (``simulated`` if recorded pressures
    stand beside it), and may have ``time_step``. Rows of a breath are in time order. If a breath
    has another number of rows than the recording, its pressures are interpolated at the recorded
    times; commands never are.

    Args:
        path: CSV, gzipped CSV or Parquet.
        breaths: n recorded breaths of T samples.

    Returns:
        cmH2O, ``(n, T)``; padding repeats the last value.

    Raises:
        InputError: if a column or a breath is missing, or the rows do not cover a breath.
    """
    table, file = _table(Path(path)), Path(path).name
    names = [name for name in COLUMNS if name in table]
    if "breath_id" not in table or not names:
        raise InputError(
            f"{file}: columns breath_id and {COLUMNS[0]} are needed; it has {', '.join(table)}"
        )
    column = names[0]
    values = _numbers(table[column], file, column)
    times = next((_numbers(table[name], file, name) for name in _TIMES if name in table), None)
    ids = _numbers(table["breath_id"], file, "breath_id")
    order = np.argsort(ids, kind="stable")
    starts = np.searchsorted(ids[order], breaths.breath_id)
    ends = np.searchsorted(ids[order], breaths.breath_id, side="right")
    answers = np.full(breaths.pressure.shape, np.nan)
    for i, number in enumerate(breaths.breath_id.tolist()):
        rows = order[starts[i] : ends[i]]
        wanted = breaths.time[i, breaths.valid[i]]
        if len(rows) == 0:
            raise InputError(f"{file} has no breath {number} of the recording")
        own, at = values[rows], None if times is None else times[rows] - times[rows][0]
        if not np.all(np.isfinite(own)):
            raise InputError(
                f"{file}: breath {number} has a blank or infinite {column}; simulate every sample"
            )
        if len(rows) != len(wanted):
            if at is None:
                raise InputError(
                    f"{file}: breath {number} has {len(rows)} rows, the recording {len(wanted)}; "
                    "simulate the recorded samples, or add a column time_step, s"
                )
            own = _at_times(own, at, wanted, file, number)
        answers[i, : len(wanted)], answers[i, len(wanted) :] = own, own[-1]
    return answers


def _at_times(
    values: NDArray[np.float64], at: NDArray[np.float64], wanted: NDArray[np.float64], file: str,
    number: int,
) -> NDArray[np.float64]:  # fmt: skip
    if len(at) < 2 or not np.all(np.diff(at) > 0):
        raise InputError(f"{file}: the times of breath {number} do not increase")
    if at[-1] < wanted[-1] - (at[-1] - at[-2]) - 1e-9:
        raise InputError(
            f"{file}: breath {number} ends at {at[-1]:g} s, the recorded one at {wanted[-1]:g} s; "
            "simulate the whole breath"
        )
    return np.interp(wanted, at, values)


def _table(path: Path) -> dict[str, np.ndarray]:
    """Columns of a table by name."""
    import pyarrow as pa
    from pyarrow import csv, parquet

    try:
        if path.suffix in (".parquet", ".pq"):
            table = parquet.read_table(path)
        else:
            table = csv.read_csv(path)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file of simulated pressures") from None
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: it cannot be read: {str(error).splitlines()[0]}") from None
    return {name: table.column(name).to_numpy() for name in dict.fromkeys(table.column_names)}


def _numbers(values: np.ndarray, file: str, name: str) -> NDArray[np.float64]:
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{file}, column {name}: not all are numbers ({error})") from None
