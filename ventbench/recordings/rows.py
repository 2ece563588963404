"""Rows of a file as flat arrays: chunks as they are read, regrouped into whole breaths."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ventbench.recordings.schema import COLUMNS

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class Chunk:
    """Consecutive rows of a file, as read.

    Attributes:
        row0: the first row's number in the file, 0 for the first data row.
        columns: arrays by column name, each (m,): int64 for id and breath_id, float64 with NaN for
            blank otherwise, in the units of the schema.
        blank_id: rows with a blank breath_id, (m,) bool; breath_id then repeats the one before.
    """

    row0: int
    columns: dict[str, np.ndarray]
    blank_id: np.ndarray

    def __len__(self) -> int:
        """Number of rows m."""
        return len(self.blank_id)

    def cut(self, start: int, stop: int) -> Chunk:
        """Rows start..stop-1, as views."""
        columns = {name: values[start:stop] for name, values in self.columns.items()}
        return Chunk(self.row0 + start, columns, self.blank_id[start:stop])


@dataclass(frozen=True)
class Rows(Chunk):
    """Rows of whole breaths.

    Attributes:
        starts: index of each breath's first row, (k,), k >= 1.
    """

    starts: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Rows in each breath, (k,)."""
        return np.diff(self.starts, append=len(self))


def whole_breaths(chunks: Iterable[Chunk], batch: int | None = None) -> Iterator[Rows]:
    """Regroup chunks of a file so that none ends inside a breath.

    Args:
        chunks: the file in order.
        batch: breaths in each group (the last may have fewer); None for groups of any size.

    Yields:
        Rows of whole breaths, in order.
    """
    held: list[Chunk] = []
    held_breaths = 0
    for chunk in chunks:
        if held and held[-1].columns["breath_id"][-1] == chunk.columns["breath_id"][0]:
            held_breaths -= 1
        held.append(chunk)
        held_breaths += len(_starts(chunk))
        if held_breaths > (batch or 1):
            rows = _join(held)
            stops = _stops(rows, batch)
            yield from _cut(rows, stops)
            rest = rows.cut(int(stops[-1]), len(rows))
            held, held_breaths = [rest], len(_starts(rest))
    if held:
        rows = _join(held)
        stops = _stops(rows, batch) if batch else np.zeros(0, dtype=np.int64)
        yield from _cut(rows, np.append(stops, len(rows)))


def _starts(chunk: Chunk) -> np.ndarray:
    ids = chunk.columns["breath_id"]
    return np.append(0, np.flatnonzero(ids[1:] != ids[:-1]) + 1)


def _stops(rows: Chunk, batch: int | None) -> np.ndarray:
    """Rows at which groups can end: the last breath may continue in the next chunk."""
    starts = _starts(rows)
    return starts[-1:] if batch is None else starts[batch::batch]


def _cut(rows: Chunk, stops: np.ndarray) -> Iterator[Rows]:
    start = 0
    for stop in stops:
        if stop > start:
            part = rows.cut(start, int(stop))
            yield Rows(part.row0, part.columns, part.blank_id, _starts(part))
        start = int(stop)


def _join(chunks: list[Chunk]) -> Chunk:
    if len(chunks) == 1:
        return chunks[0]
    columns = {
        name: np.concatenate([chunk.columns[name] for chunk in chunks])
        for name in chunks[0].columns
    }
    blank = np.concatenate([chunk.blank_id for chunk in chunks])
    return Chunk(chunks[0].row0, columns, blank)


def chunk_of_batch(batch: pa.RecordBatch, row0: int, last_id: int | None) -> Chunk:
    """Convert an Arrow batch.

    Args:
        batch: known columns only, in any numeric type.
        row0: number of its first row in the file.
        last_id: breath_id of the row before, used where the first ones are blank; None at the
            start, where the first id that is not blank is used.

    Returns:
        The rows as int64 (id, breath_id) and float64 arrays.

    Raises:
        pyarrow.ArrowInvalid: a whole number does not fit 64 bits.
    """
    columns = {}
    blank_id = np.zeros(batch.num_rows, dtype=bool)
    for name in batch.schema.names:
        values, blank = _numpy(batch.column(name), COLUMNS[name].whole)
        if name == "breath_id" and blank is not None:
            blank_id = blank
            before = np.maximum.accumulate(np.where(blank, -1, np.arange(len(values))))
            first = values[int(np.argmin(blank))] if last_id is None else last_id
            values = np.where(before < 0, first, values[before])
        columns[name] = values
    return Chunk(row0, columns, blank_id)


def _numpy(array: pa.Array, whole: bool) -> tuple[np.ndarray, np.ndarray | None]:
    import pyarrow as pa

    if whole:
        blank = array.is_null().to_numpy(zero_copy_only=False) if array.null_count else None
        filled = array.fill_null(0) if array.null_count else array
        return filled.cast(pa.int64()).to_numpy(zero_copy_only=False), blank
    if array.type != pa.float64():
        array = array.cast(pa.int8()) if pa.types.is_boolean(array.type) else array
        array = array.cast(pa.float64())
    return array.to_numpy(zero_copy_only=False), None
