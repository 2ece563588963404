"""From Arrow to numpy: one batch of rows as a Chunk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ventbench.recordings.rows import Chunk
from ventbench.recordings.schema import COLUMNS

if TYPE_CHECKING:
    import pyarrow as pa


def to_chunk(batch: pa.RecordBatch, row0: int, last_id: int | None) -> Chunk:
    """Convert a batch.

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
