"""Parquet problems name the row, and types are checked before values."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from ventbench.recordings import RecordingError, check, load, write


@pytest.fixture
def table(make, tmp_path):
    write(make(3), tmp_path / "lab.parquet")
    return parquet.read_table(tmp_path / "lab.parquet")


def replaced(table, path, **columns):
    for name, values in columns.items():
        table = table.set_column(table.schema.get_field_index(name), name, values)
    parquet.write_table(table, path)
    return path


def test_a_bad_value_names_its_row(table, tmp_path):
    u_in = table["u_in"].to_numpy().copy()
    u_in[9] = 104.2
    path = replaced(table, tmp_path / "bad.parquet", u_in=pa.array(u_in))
    with pytest.raises(RecordingError) as caught:
        load(path)
    text = f"{path} row 10, column u_in: 104.2 is outside 0..100 %. Fix the row or pass --clip."
    assert str(caught.value) == text
    assert caught.value.problems[0].value == "104.2"


def test_progress_ends_at_the_whole_file(make, tmp_path):
    """Bytes of text, rows of Parquet."""
    for name in ("lab.csv", "lab.csv.gz", "lab.parquet"):
        path = tmp_path / name
        write(make(3), path)
        whole = 24 if name == "lab.parquet" else path.stat().st_size
        for read in (load, check):
            told = []
            read(path, progress=lambda *counts, told=told: told.append(counts))
            assert told[-1] == (whole, whole), name


def test_wrong_types(table, tmp_path):
    words = pa.array([str(x) for x in table["u_in"].to_pylist()])
    floats = pa.array(np.asarray(table["breath_id"], dtype=float))
    path = replaced(table, tmp_path / "bad.parquet", u_in=words, breath_id=floats)
    error = check(path)
    assert [(p.column, p.value) for p in error.problems] == [
        ("breath_id", "double"),
        ("u_in", "string"),
    ]
    assert "Write it as int64." in str(error.problems[0])
    assert "the column has type string, but numbers are needed" in str(error.problems[1])


def test_other_numeric_types_are_taken(table, tmp_path):
    path = replaced(
        table,
        tmp_path / "small.parquet",
        u_in=table["u_in"].cast(pa.float32()),
        u_out=table["u_out"].cast(pa.bool_()),
        breath_id=table["breath_id"].cast(pa.uint16()),
        R=table["R"].cast(pa.int32()),
    )
    breaths = load(path)
    np.testing.assert_array_equal(breaths.breath_id, [1, 2, 3])
    np.testing.assert_array_equal(breaths.R, [5.0, 20.0, 50.0])
    np.testing.assert_array_equal(breaths.u_out.ravel(), table["u_out"].to_numpy())


def test_blank_ids_and_a_damaged_file(table, tmp_path):
    ids = table["breath_id"].to_pylist()
    ids[0] = ids[10] = None
    path = replaced(table, tmp_path / "bad.parquet", breath_id=pa.array(ids, pa.int64()))
    problems = check(path).problems
    assert [(p.line, p.column) for p in problems if "blank" in p.what] == [
        (1, "breath_id"),
        (11, "breath_id"),
    ]
    data = bytearray(path.read_bytes())
    data[4:-400] = bytes(len(data) - 404)
    path.write_bytes(data)
    assert "the file cannot be read" in str(check(path).problems[0])


def test_missing_columns(table, tmp_path):
    path = tmp_path / "bad.parquet"
    parquet.write_table(table.drop_columns(["pressure"]), path)
    assert f"{path}, column pressure: missing column pressure." in str(check(path).problems[0])


def test_a_spreadsheet_is_sent_to_the_import(tmp_path):
    (path := tmp_path / "breaths.xlsx").write_bytes(b"PK\x03\x04")
    (problem,) = check(path).problems
    assert "spreadsheet" in problem.what
    assert "data import" in problem.advice


def test_the_file_of_another_ventilator_is_sent_to_its_reader(tmp_path):
    names = ("run", "test", "breath", "cmd_inh_valve", "cmd_exh_valve", "R", "C", "pressure")
    path = tmp_path / "rw.parquet"
    parquet.write_table(pa.table({name: np.zeros(6) for name in names}), path)
    with pytest.raises(
        RecordingError, match=r"missing columns id, breath_id.*data import --select"
    ):
        load(path)
