"""A recording file of any kind, opened for reading once in order."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping

from ventbench.recordings.csv_in import CsvSource
from ventbench.recordings.csv_text import locate_rows
from ventbench.recordings.files import kind_of
from ventbench.recordings.findings import Place
from ventbench.recordings.parquet_in import ParquetSource

Source = CsvSource | ParquetSource


def open_source(path: str | os.PathLike[str]) -> Source:
    """Open a file and check its header.

    Raises:
        RecordingError: the file cannot be read or is no recording.
    """
    kind = kind_of(path)
    return ParquetSource(str(path)) if kind == "parquet" else CsvSource(str(path), kind)


def locate(source: Source, rows: Collection[int]) -> Mapping[int, Place]:
    """Find data rows (0 for the first) in a file: line and cells, or in Parquet the row from 1."""
    if isinstance(source, ParquetSource):
        return {row: (row + 1, {}) for row in rows}
    return locate_rows(source.file, source.kind, source.names, rows)
