"""Writing recordings as CSV, gzipped CSV or Parquet."""

from __future__ import annotations

import gzip
import os
from contextlib import ExitStack
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

import numpy as np

from ventbench.base.errors import InputError
from ventbench.base.files import write_atomically
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.schema import COLUMNS, OPTIONAL

if TYPE_CHECKING:
    import pyarrow as pa

BATCH = 4096
"""Breaths that are converted to a table at a time."""


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
    if name.endswith((".parquet", ".pq")):
        write_atomically(Path(path), lambda out: _write_parquet(breaths, out, blank_inferred))
    else:
        packed = name.endswith(".gz")
        write_atomically(
            Path(path), lambda out: _write_csv(breaths, out, blank_inferred, packed=packed)
        )


def _write_csv(breaths: Breaths, stream: IO[bytes], blank: bool, *, packed: bool) -> None:
    import pyarrow as pa
    from pyarrow import csv

    schema = _schema(breaths)
    with ExitStack() as stack:
        out: IO[bytes] = stream
        if packed:
            zipped = gzip.GzipFile("", "wb", compresslevel=6, fileobj=stream, mtime=0)
            out = cast("IO[bytes]", stack.enter_context(zipped))
        out.write((",".join(schema.names) + "\n").encode())
        options = csv.WriteOptions(include_header=False)
        sink = pa.PythonFile(out, "w")
        with csv.CSVWriter(sink, schema, write_options=options) as writer:
            for first in range(0, len(breaths), BATCH):
                writer.write_table(_table(breaths, slice(first, first + BATCH), schema, blank))


def _write_parquet(breaths: Breaths, stream: IO[bytes], blank: bool) -> None:
    from pyarrow import parquet

    schema = _schema(breaths)
    with parquet.ParquetWriter(stream, schema, compression="zstd") as writer:
        for first in range(0, len(breaths), BATCH):
            writer.write_table(_table(breaths, slice(first, first + BATCH), schema, blank))


def _schema(breaths: Breaths) -> pa.Schema:
    import pyarrow as pa

    kinds = {"id": pa.int64(), "breath_id": pa.int64(), "u_out": pa.int8()}
    for name, values in (("R", breaths.R), ("C", breaths.C)):
        if (values == np.round(values)).all():
            kinds[name] = pa.int64()
    return pa.schema(
        [
            pa.field(name, kinds.get(name, pa.float64()), metadata={"unit": column.unit})
            for name, column in COLUMNS.items()
            if name not in OPTIONAL or getattr(breaths, name) is not None
        ]
    )


def _table(breaths: Breaths, span: slice, schema: pa.Schema, blank: bool) -> pa.Table:
    import pyarrow as pa

    columns = breaths.columns(span, blank_inferred=blank)
    arrays = [pa.array(columns[field.name], from_pandas=True).cast(field.type) for field in schema]
    return pa.Table.from_arrays(arrays, schema=schema)
