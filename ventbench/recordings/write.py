"""Writing recordings as CSV, gzipped CSV or Parquet."""

from __future__ import annotations

import gzip
import os
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

import numpy as np

from ventbench.base.errors import InputError
from ventbench.base.files import write_atomically
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.schema import COLUMNS

if TYPE_CHECKING:
    import pyarrow as pa


def write(breaths: Breaths, path: str | os.PathLike[str], *, blank_inferred: bool = True) -> None:
    """Write breaths to CSV, gzipped CSV or Parquet, by the ending of the name.

    Numbers read back exactly. Padding is left out; NaN is written blank. The same breaths give the
    same bytes. An existing file is replaced, a missing folder made. Inferred times are written
    blank, as they were read, so that nobody takes them for measurements; or else the estimates.

    Raises:
        InputError: if there are no breaths, or the name has another ending.
        OSError: if the file cannot be written.
    """
    name = str(path)
    if len(breaths) == 0:
        raise InputError(f"{name}: there are no breaths to write")
    if not name.endswith((".csv", ".csv.gz", ".parquet", ".pq")):
        raise InputError(f"{name}: the name must end in .csv, .csv.gz, .parquet or .pq")
    table = _table(breaths, blank_inferred)
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


def _table(breaths: Breaths, blank_inferred: bool) -> pa.Table:
    """Columns of the schema with their units; labels that are whole numbers are written as such."""
    import pyarrow as pa

    columns = breaths.columns(blank_inferred=blank_inferred)
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
