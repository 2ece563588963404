"""Reading CSV in pieces: fast while the text is sound."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, field

from ventbench.recordings.arrow import to_chunk
from ventbench.recordings.csv_text import data_lines, text_problems
from ventbench.recordings.errors import Problem, RecordingError
from ventbench.recordings.files import HashingReader, Kind, fail, open_bytes
from ventbench.recordings.header import check_names
from ventbench.recordings.rows import Chunk
from ventbench.recordings.schema import COLUMNS

BLOCK = 8 << 20
"""Bytes of text read at a time (the parser holds a few of them)."""
BLANKS = ["", "NaN", "nan", "NA", "N/A", "null"]


@dataclass
class CsvSource:
    """A CSV file being read, once.

    Attributes:
        file: the path as the caller wrote it.
        kind: `csv` or `csv.gz`.
        names: column names of the header.
        warnings: columns that are ignored.
        sha256: of the file on disk, known once all chunks were read.
    """

    file: str
    kind: Kind
    names: tuple[str, ...] = ()
    warnings: tuple[Problem, ...] = ()
    sha256: str | None = None
    place: str = field(default="line", init=False)

    def __post_init__(self) -> None:
        """Read and check the header.

        Raises:
            RecordingError: the header is not one of a recording.
        """
        self.names = _header(self.file, self.kind)
        self.warnings = check_names(self.file, self.names, 1)

    def chunks(self) -> Iterator[Chunk]:
        """Yield the rows in order.

        Raises:
            RecordingError: the text cannot be read as numbers.
        """
        import pyarrow as pa

        reader = HashingReader(self.file)
        try:
            yield from self._parse(reader)
            self.sha256 = reader.finish()
        except pa.ArrowInvalid as error:
            if next(data_lines(self.file, self.kind), None) is None:  # a header alone
                self.sha256 = reader.finish()
                return
            problems, total = text_problems(self.file, self.kind, self.names)
            if not problems:
                raise fail(self.file, str(error).strip().rstrip("."), "Fix the file.") from None
            raise RecordingError(problems, total) from None
        except (OSError, EOFError) as error:
            advice = "Copy or download the file again."
            raise fail(self.file, f"the file cannot be read ({error})", advice) from None
        finally:
            reader.release()

    def _parse(self, reader: HashingReader) -> Iterator[Chunk]:
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        stream = pa.PythonFile(reader, "r")
        if self.kind == "csv.gz":
            stream = pa.CompressedInputStream(stream, "gzip")
        whole = {name: column.whole for name, column in COLUMNS.items() if name in self.names}
        convert = arrow_csv.ConvertOptions(
            column_types={name: pa.int64() if is_whole else pa.float64()
                          for name, is_whole in whole.items()},
            include_columns=list(whole),
            null_values=BLANKS,
        )  # fmt: skip
        options = arrow_csv.ReadOptions(
            block_size=BLOCK, skip_rows=1, column_names=list(self.names)
        )
        batches = arrow_csv.open_csv(stream, read_options=options, convert_options=convert)
        row0, last_id = 0, None
        for batch in batches:
            if batch.num_rows:
                chunk = to_chunk(batch, row0, last_id)
                yield chunk
                row0 += len(chunk)
                last_id = int(chunk.columns["breath_id"][-1])


def _header(file: str, kind: Kind) -> tuple[str, ...]:
    try:
        with open_bytes(file, kind) as stream:
            first = stream.readline(1 << 16)
    except (OSError, EOFError) as error:
        advice = "Copy or download the file again."
        raise fail(file, f"the file cannot be read ({error})", advice) from None
    try:
        text = first.decode("utf-8-sig").rstrip("\r\n")
    except UnicodeDecodeError as error:
        what = f"byte 0x{first[error.start]:02x} is not UTF-8"
        raise fail(file, what, "Save the file as UTF-8 text.", 1) from None
    if "\r" in text:
        raise fail(file, "lines end in CR alone", "Save the file with LF or CRLF line ends.", 1)
    if not text.strip():
        raise fail(file, "the first line is blank", "Put the header there.", 1)
    return tuple(next(csv.reader([text])))
