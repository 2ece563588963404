"""Files as bytes: what kind a file is, opening it, hashing it while it is read."""

from __future__ import annotations

import gzip
import hashlib
import os
from pathlib import Path
from typing import IO, Literal

from ventbench.recordings.errors import Problem, RecordingError

Kind = Literal["csv", "csv.gz", "parquet"]


def kind_of(path: str | os.PathLike[str]) -> Kind:
    """Tell what a file is from its first bytes; the name decides only between complaints.

    Raises:
        RecordingError: no such file, a folder, no permission, empty, or another format.
    """
    name = str(path)
    try:
        if Path(path).is_dir():
            raise fail(name, "this is a folder", "Name one file in it.")
        with open(path, "rb") as stream:
            first = stream.read(4)
    except FileNotFoundError:
        raise fail(name, "there is no such file", "Check the path.") from None
    except OSError as error:
        advice = "Check its permissions."
        raise fail(name, f"the file cannot be read ({error.strerror})", advice) from None
    if not first:
        raise fail(name, "the file is empty", "Write a header and at least one breath.")
    if first == b"PAR1":
        return "parquet"
    if name.endswith((".parquet", ".pq")):
        advice = "Write it again, or name it .csv if it is text."
        raise fail(name, "this is not a Parquet file", advice)
    if first.startswith(b"\x1f\x8b"):
        return "csv.gz"
    if first.startswith(b"PK\x03\x04"):
        raise fail(name, "this is a zip archive", "Unpack it and name the CSV file in it.")
    if first.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise fail(name, "this is UTF-16 text", "Save the file as UTF-8.")
    return "csv"


def fail(file: str, what: str, advice: str, line: int | None = None) -> RecordingError:
    """A RecordingError about a whole file or a line."""
    return RecordingError(Problem(file, what, advice, line))


def open_bytes(path: str | os.PathLike[str], kind: Kind) -> IO[bytes]:
    """Open the plain bytes of a CSV file, unpacked if it is packed."""
    if kind == "csv.gz":
        return gzip.open(path, "rb")  # type: ignore[return-value]
    return open(path, "rb")


class HashingReader:
    """A binary file that hashes what is read from it: what was hashed is what was parsed."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open the file at `path`."""
        self._stream = open(path, "rb")  # noqa: SIM115 (closed by close)
        self._hash = hashlib.sha256()

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""
        return self._stream.closed

    def read(self, size: int = -1) -> bytes:
        """Read and hash up to `size` bytes."""
        data = self._stream.read(size)
        self._hash.update(data)
        return data

    def readable(self) -> bool:
        """True."""
        return True

    def writable(self) -> bool:
        """False."""
        return False

    def seekable(self) -> bool:
        """False: bytes are read once, in order."""
        return False

    def finish(self) -> str:
        """Hash what is left of the file, if any, and give the SHA-256 in hex."""
        while self.read(1 << 20):
            pass
        return self._hash.hexdigest()

    def close(self) -> None:
        """Do nothing: the parser closes its input early, before `finish`."""

    def release(self) -> None:
        """Close the file."""
        self._stream.close()
