"""Small files that claim or unpack to much more than fits: refused by size, before it is there."""

from __future__ import annotations

import gzip
import runpy
import sys
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from scipy.io import savemat

from ventbench.base.errors import InputError
from ventbench.recordings.foreign import sizes
from ventbench.recordings.foreign.formats import read_table

#: What the tests allow in the place of gigabytes, and most memory that a refusal may take, bytes.
LARGEST, SPENT = 4_000_000, 8_000_000


def wfdb_header(folder: Path) -> Path:
    path = folder / "claims.hea"
    path.write_text("claims 2 250 100000000000000\nclaims.dat 16 200 16 0 0 0 0 Paw\n" * 1)
    path.write_text(path.read_text() + "claims.dat 16 200 16 0 0 0 0 Flow\n")
    (folder / "claims.dat").write_bytes(b"\0" * 8)
    return path


def edf(folder: Path, records: str = "99999999", count: int = 99999999) -> Path:
    head = b"0".ljust(8) + b" " * 160 + b"01.01.0101.01.01" + b"512".ljust(8) + b" " * 44
    head += records.encode().ljust(8) + b"1".ljust(8) + b"1".ljust(4)
    fields = ("Paw", "", "cmH2O", "0", "100", "-32768", "32767", "", str(count), "")
    widths = (16, 80, 8, 8, 8, 8, 8, 80, 8, 32)
    signal = b"".join(x.encode().ljust(w) for x, w in zip(fields, widths, strict=True))
    path = folder / "claims.edf"
    path.write_bytes(head + signal + b"\0" * 8)
    return path


def zeros(folder: Path) -> Path:
    path = folder / "zeros.parquet"
    column = pa.array(np.zeros(1_000_000))
    parquet.write_table(pa.table({"pressure": column}), path, compression="zstd")
    return path


def spreadsheet(folder: Path, sheet: bytes) -> Path:
    openpyxl = pytest.importorskip("openpyxl")
    path, other = folder / "plain.xlsx", folder / "bomb.xlsx"
    book = openpyxl.Workbook()
    book.active.append(["time", "pressure"])
    book.save(path)
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(other, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            is_sheet = name == "xl/worksheets/sheet1.xml"
            new.writestr(name, sheet if is_sheet else old.read(name))
    return other


def large_spreadsheet(folder: Path) -> Path:
    return spreadsheet(folder, b"<worksheet>" + b" " * 6_000_000 + b"</worksheet>")


def wide_spreadsheet(folder: Path) -> Path:
    """One cell at the far corner: a reader pads what is before it."""
    space = b'<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main">'
    cell = b'<sheetData><row r="1048576"><c r="XFD1048576"><v>1</v></c></row></sheetData>'
    return spreadsheet(folder, space + b'<dimension ref="A1:XFD1048576"/>' + cell + b"</worksheet>")


def gzipped(folder: Path) -> Path:
    path = folder / "zeros.csv.gz"
    path.write_bytes(gzip.compress(b"0,0\n" * 2_000_000))
    return path


def matlab(folder: Path) -> Path:
    path = folder / "zeros.mat"
    savemat(path, {"pressure": np.zeros(1_000_000)}, do_compression=True)
    return path


ATTACKS = [wfdb_header, edf, zeros, large_spreadsheet, wide_spreadsheet, gzipped, matlab]


@pytest.mark.parametrize("make", ATTACKS, ids=lambda make: make.__name__)
def test_it_is_refused_before_it_is_unpacked(
    make: Callable[[Path], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if make is wfdb_header:
        pytest.importorskip("wfdb")
    if make is edf:
        pytest.importorskip("pyedflib", reason="pyedflib has no wheel for this Python")
    path = make(tmp_path)
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(sizes, "LARGEST", LARGEST)
    tracemalloc.start()
    try:
        said = r"cannot be read as EDF" if make is edf else r"more than the 0\.004 GB that are read"
        with pytest.raises(InputError, match=said):
            read_table(path)
        spent = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert spent < SPENT + LARGEST


def test_a_header_must_not_claim_what_is_not_there(tmp_path: Path) -> None:
    pytest.importorskip("pyedflib", reason="pyedflib has no wheel for this Python")
    with pytest.raises(InputError, match=r"cannot be read as EDF .*Filesize"):
        read_table(edf(tmp_path, "10", 100))


def test_the_limit_leaves_room_for_the_public_set() -> None:
    assert sizes.LARGEST > 8 * 8 * 6_036_000


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read from /proc")
def test_an_import_of_900_000_rows_fits_in_300_mb(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[2]
    benchmark = runpy.run_path(str(root / "benchmarks" / "load_recordings.py"))
    benchmark["write_foreign"](tmp_path / "foreign.csv", 900_000)
    breaths, _, peak = benchmark["measure"](benchmark["IMPORT"], tmp_path / "foreign.csv")
    assert breaths == 2998
    assert peak < benchmark["BARS"]["import"][1]
