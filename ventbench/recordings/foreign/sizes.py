"""What foreign files unpack to, by what they say of themselves, before anything is unpacked.

A header of a hundred bytes can claim 1e14 samples, and ten kilobytes of Parquet, spreadsheet,
gzip or MATLAB can hold gigabytes of zeros. Each function raises :class:`InputError` where a file
would take more than :data:`LARGEST` bytes.
"""

from __future__ import annotations

import gzip
import math
import struct
import zipfile
import zlib
from typing import Any

from ventbench.base.errors import InputError

#: Most bytes that a table may take in memory: eight columns of 30 million rows, five times the
#: public set of the People's Ventilator.
LARGEST = 2_000_000_000

# Of MATLAB files: bytes of an element that say what it is, and numbers of its kinds and classes.
_HEAD, _COMPRESSED, _NESTED = 512, 15, (1, 2, 3)

#: Bytes of a number, and of a spreadsheet's cell once it is an object.
_NUMBER, CELL = 8, 40


def refuse(file: str, size: float, part: str) -> None:
    """Refuse a size, bytes, of what a file holds."""
    if size > LARGEST:
        raise InputError(
            f"{file}: {part} take {size / 1e9:.3g} GB, more than the {LARGEST / 1e9:g} GB that are "
            "read; export a part of it"
        )


def check_parquet(file: str) -> None:
    """Check the rows and columns, and the pages, that the footer of a Parquet file claims."""
    from pyarrow import parquet

    metadata = parquet.read_metadata(file)
    groups = (metadata.row_group(k) for k in range(metadata.num_row_groups))
    pages = sum(group.total_byte_size for group in groups)
    values = _NUMBER * metadata.num_rows * max(metadata.num_columns, 1)
    refuse(file, max(pages, values), f"its {metadata.num_rows} rows")


def check_archive(file: str) -> None:
    """Check what the members of a zip archive, such as a spreadsheet, unpack to."""
    with zipfile.ZipFile(file) as archive:
        refuse(file, sum(member.file_size for member in archive.infolist()), "its unpacked parts")


def check_numpy(file: str) -> None:
    """Check the shapes of the arrays of a ``.npy`` or ``.npz`` file, by their headers."""
    import numpy as np

    def size(stream: Any) -> int:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0
        shape, _, kind = (read if version == (1, 0) else np.lib.format.read_array_header_2_0)(
            stream
        )
        return math.prod(shape) * max(kind.itemsize, _NUMBER)

    if not zipfile.is_zipfile(file):
        with open(file, "rb") as stream:
            refuse(file, size(stream), "its array")
        return
    total = 0
    with zipfile.ZipFile(file) as archive:
        for member in archive.namelist():
            with archive.open(member) as stream:
                total += size(stream)
    refuse(file, total, "its arrays")


def check_matlab(file: str) -> None:
    """Check the shapes of the variables of a MATLAB file of level 5.

    Each is an element of its own, compressed or not, that begins with its size, its class and its
    shape; no more than these is unpacked. What lies in structures may be packed eight to one.
    """
    total = 0
    with open(file, "rb") as stream:
        order = ">" if stream.read(128)[126:] == b"MI" else "<"
        while len(tag := stream.read(8)) == 8:
            kind, length = struct.unpack(f"{order}2I", tag)
            following = stream.tell() + length
            head = stream.read(min(length, _HEAD))
            if kind == _COMPRESSED:
                head = zlib.decompressobj().decompress(head, _HEAD)
            else:
                head = tag + head
            if len(head) >= 32:
                words = struct.unpack_from(f"{order}8I", head)
                count = min(words[7] // 4, (len(head) - 32) // 4)
                shape = struct.unpack_from(f"{order}{count}I", head, 32)
                nested = words[4] & 0xFF in _NESTED
                total += _NUMBER * (words[1] if nested else math.prod(shape))
            stream.seek(following)
    refuse(file, total, "its variables")


def check_wfdb(file: str) -> None:
    """Check the samples that the header of a WFDB record claims."""
    import wfdb

    header = wfdb.rdheader(file.removesuffix(".hea"))
    samples = (header.sig_len or 0) * (getattr(header, "n_sig", 1) or 1)
    refuse(file, _NUMBER * samples, f"{samples:.3g} samples by its header")


def gunzipped(file: str) -> bytes:
    """Unpack a gzipped file, and stop at :data:`LARGEST` bytes.

    Raises:
        InputError: if it unpacks to more, or cannot be unpacked.
    """
    parts, size = [], 0
    try:
        with gzip.open(file) as stream:
            while part := stream.read(1 << 20):
                parts.append(part)
                size += len(part)
                refuse(file, size, "its unpacked contents")
    except EOFError:
        raise InputError(f"{file} cannot be unpacked: it ends early; copy it again") from None
    except (zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{file} cannot be unpacked ({error})") from None
    return b"".join(parts)
