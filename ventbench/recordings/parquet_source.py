"""Reading Parquet in batches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ventbench.files import sha256
from ventbench.recordings.problems import RecordingError, RecordingProblem, fail
from ventbench.recordings.rows import Chunk, chunk_of_batch
from ventbench.recordings.schema import COLUMNS, Kind, check_header

if TYPE_CHECKING:
    import pyarrow as pa

BATCH = 1 << 17
"""Rows read at a time."""


@dataclass
class ParquetSource:
    """A Parquet file that is read once, in order.

    Attributes:
        file: the path as the caller wrote it.
        kind: `parquet`.
        names: column names.
        warnings: about columns that are ignored.
        sha256: SHA-256 of the file; None until all chunks are read.
        batch: rows that are read at a time.
        size: rows of the file.
        done: rows that have been read.
    """

    file: str
    kind: Kind = "parquet"
    names: tuple[str, ...] = ()
    warnings: tuple[RecordingProblem, ...] = ()
    sha256: str | None = None
    place: str = field(default="row", init=False)
    batch: int = BATCH
    size: int = field(default=0, init=False)
    done: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        """Read and check names and types.

        Raises:
            RecordingError: the file is damaged, or its columns are not those of a recording.
        """
        import pyarrow as pa
        from pyarrow import parquet

        try:
            schema = parquet.read_schema(self.file)
        except (pa.ArrowException, OSError) as error:
            raise _damaged(self.file, error) from None
        self.names = tuple(schema.names)
        self.warnings = check_header(self.file, self.names, None)
        problems = [
            problem
            for name in self.names
            if name in COLUMNS
            for problem in _check_type(self.file, name, schema.field(name).type)
        ]
        if problems:
            raise RecordingError(problems)

    def chunks(self) -> Iterator[Chunk]:
        """Yield the rows in order.

        Raises:
            RecordingError: the file is damaged.
        """
        import pyarrow as pa
        from pyarrow import parquet

        row0, last_id = 0, None
        try:
            with parquet.ParquetFile(self.file) as stream:
                self.size = stream.metadata.num_rows
                columns = [name for name in COLUMNS if name in self.names]
                for batch in stream.iter_batches(self.batch, columns=columns):
                    if batch.num_rows:
                        chunk = chunk_of_batch(batch, row0, last_id)
                        self.done = row0 + len(chunk)
                        yield chunk
                        row0 += len(chunk)
                        last_id = int(chunk.columns["breath_id"][-1])
            self.sha256 = sha256(Path(self.file))
        except (pa.ArrowException, OSError) as error:
            raise _damaged(self.file, error) from None


def _check_type(file: str, name: str, kind: pa.DataType) -> Iterator[RecordingProblem]:
    from pyarrow import types

    if COLUMNS[name].whole:
        good, needed = types.is_integer(kind), "int64"
    else:
        good, needed = types.is_integer(kind) or types.is_floating(kind), "double"
        good = good or (name == "u_out" and types.is_boolean(kind))
    if not good:
        what = f"the column has type {kind}, but numbers are needed"
        yield RecordingProblem(file, what, f"Write it as {needed}.", None, name, str(kind), "row")


def _damaged(file: str, error: Exception) -> RecordingError:
    text = str(error).strip().splitlines()[0].rstrip(".")
    return fail(file, f"the Parquet file cannot be read ({text})", "Write or copy it again.")
