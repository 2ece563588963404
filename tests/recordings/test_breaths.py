"""The container, padding, round trips and joins."""

from __future__ import annotations

import gzip
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ventbench.base.errors import InputError
from ventbench.recordings import Breaths, join, load, make_breaths, sources, write

FIELDS = [
    "breath_id",
    "R",
    "C",
    "time",
    "dt",
    "u_in",
    "u_out",
    "pressure",
    "valid",
    "time_inferred",
    "flow",
    "volume",
]


def same(a: Breaths, b: Breaths) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert getattr(getattr(a, name), "dtype", None) == getattr(getattr(b, name), "dtype", None)


def test_what_is_loaded(rows, write_csv):
    breaths = load(write_csv(rows))
    assert len(breaths) == 3
    np.testing.assert_array_equal(breaths.breath_id, [1, 2, 3])
    np.testing.assert_array_equal(breaths.time, np.tile(0.25 * np.arange(6), (3, 1)))
    np.testing.assert_array_equal(breaths.dt, np.full((3, 6), 0.25))
    np.testing.assert_array_equal(breaths.u_in[2], 10.0 + np.arange(6))
    np.testing.assert_array_equal(breaths.u_out[1], [0, 0, 0, 0, 1, 1])
    np.testing.assert_array_equal(breaths.pressure[1], 6.0 + np.arange(6))
    np.testing.assert_array_equal(breaths.inspiratory, breaths.u_out == 0)
    assert breaths.valid.all()
    assert breaths.flow is None
    assert breaths.lung_ids.tolist() == ["R5C10"] * 3
    assert breaths.sha256 is not None
    assert "3 breaths x 6 samples" in repr(breaths)
    with pytest.raises(ValueError, match="read-only"):
        breaths.u_in[0, 0] = 1.0


def test_the_hash_is_that_of_the_file(rows, write_csv, tmp_path):
    import hashlib

    path = write_csv(rows)
    assert load(path).sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    packed = tmp_path / "lab.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert load(packed).sha256 == hashlib.sha256(packed.read_bytes()).hexdigest()
    same(load(packed), load(path))


def test_column_order_bom_crlf_and_blank_pressure(rows, write_csv):
    rows[3][7] = ""
    plain = load(write_csv(rows))
    assert np.isnan(plain.pressure[0, 3])
    assert "1 of 18 pressures are blank." in plain.notes
    turned = [row[::-1] for row in rows]
    header = "\ufeff" + ",".join(
        ["id", "breath_id", "R", "C", "time_step", "u_in", "u_out", "pressure"][::-1]
    )
    same(load(write_csv(turned, header=header, end="\r\n", name="turned.csv")), plain)


def test_select_and_by_lung(make):
    breaths = make(10, optional=True)
    by_lung = breaths.by_lung()
    assert list(by_lung) == ["R5C10", "R20C10", "R50C10"]
    assert sum(len(part) for part in by_lung.values()) == 10
    same(breaths.select([7, 2]), breaths.select(np.array([7, 2])))
    assert breaths.select([7, 2]).breath_id.tolist() == [8, 3]
    assert breaths.select(breaths.R == 20.0).lung_ids.tolist() == ["R20C10"] * 3
    assert len(breaths.select([])) == 0
    assert len(breaths.select(slice(2, 5))) == 3
    with pytest.raises(IndexError):
        breaths.select([10])


def test_padding(rows, write_csv):
    breaths = load(write_csv(rows[:10] + rows[12:]), pad=True)
    assert breaths.valid.sum(axis=1).tolist() == [6, 4, 6]
    assert breaths.valid[1].tolist() == [True] * 4 + [False] * 2
    np.testing.assert_array_equal(breaths.time[1], breaths.time[0])
    np.testing.assert_array_equal(breaths.dt, np.full((3, 6), 0.25))
    assert breaths.u_in[1, 4:].tolist() == [0.0, 0.0]
    assert breaths.u_out[1, 4:].tolist() == [1, 1]
    assert np.isnan(breaths.pressure[1, 4:]).all()
    assert "Breaths have 4 to 6 samples." in breaths.notes


def test_breaths_do_not_depend_on_how_much_is_read_at_a_time(make, tmp_path, monkeypatch):
    whole = make(40)
    monkeypatch.setattr(sources, "BLOCK", 700)
    monkeypatch.setattr(sources, "BATCH", 11)
    for name in ("a.csv", "a.parquet"):
        path, told = tmp_path / name, []
        write(whole, path)
        again = load(path, progress=lambda *counts, told=told: told.append(counts))
        assert len(told) > 1
        np.testing.assert_array_equal(again.breath_id, whole.breath_id)
        for field in ("time", "u_in", "u_out", "pressure"):
            np.testing.assert_array_equal(getattr(again, field), getattr(whole, field))


finite = st.floats(-20.0, 120.0)


@st.composite
def some_breaths(draw) -> Breaths:
    n, samples = draw(st.integers(1, 5)), draw(st.integers(2, 6))
    size = n * samples

    def array(elements):
        return np.array(draw(st.lists(elements, min_size=size, max_size=size))).reshape(n, samples)

    steps = array(st.floats(1e-4, 1.0))
    time = np.cumsum(steps, axis=1)
    ids = st.integers(-(2**63), 2**63 - 1)
    optional = draw(st.booleans())
    return make_breaths(
        draw(st.lists(ids, min_size=n, max_size=n, unique=True)),
        draw(st.lists(st.floats(1e-3, 500.0), min_size=n, max_size=n)),
        draw(st.lists(st.sampled_from([10.0, 20.0, 50.0]), min_size=n, max_size=n)),
        time - time[:, :1],
        array(st.floats(0.0, 100.0)),
        array(st.integers(0, 1)),
        array(st.one_of(finite, st.just(np.nan))),
        flow=array(finite) if optional else None,
        volume=array(finite) if optional else None,
    )


@settings(max_examples=60)
@given(some_breaths(), st.sampled_from(["a.csv", "a.csv.gz", "a.parquet"]))
def test_round_trip(breaths, name):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(breaths, path)
        first = path.read_bytes()
        same(load(path), breaths)
        write(load(path), path)
        assert path.read_bytes() == first
        assert [p.name for p in path.parent.iterdir()] == [name]


def test_padding_and_inferred_times_are_written_as_they_were_read(rows, write_csv, tmp_path):
    for row in rows[12:]:
        row[4] = ""
    path = write_csv(rows[:10] + rows[12:])
    breaths = load(path, pad=True)
    write(breaths, tmp_path / "again.csv")
    same(load(tmp_path / "again.csv", pad=True), breaths)
    again = (tmp_path / "again.csv").read_text().splitlines()
    assert len(again) == 17
    assert again[-1].split(",")[4] == ""


def test_what_cannot_be_written(make, tmp_path):
    with pytest.raises(InputError, match=r"must end in \.csv"):
        write(make(2), tmp_path / "a.txt")
    with pytest.raises(InputError, match="no breaths"):
        write(make(2).select([]), tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"breath_id": [1, 1]}, "same id twice"),
        ({"time": [[0.0, 1.0], [0.5, 1.0]]}, "start at 0"),
        ({"time": [[0.0, 1.0], [0.0, 0.0]]}, "increase"),
        ({"time": [0.0, 1.0]}, "T >= 2"),
        ({"u_in": [[1.0, 2.0]]}, "u_in has shape"),
        ({"R": [5.0]}, "R has shape"),
    ],
)
def test_arrays_that_do_not_fit(change, text):
    pair = [[0.0, 1.0], [0.0, 1.0]]
    good = {"breath_id": [1, 2], "R": [5.0, 5.0], "C": [10.0, 10.0], "time": pair}
    good |= {"u_in": pair, "u_out": pair, "pressure": pair}
    assert len(make_breaths(**good)) == 2
    with pytest.raises(ValueError, match=text):
        make_breaths(**(good | change))


JOINED = (
    "breath_id",
    "R",
    "C",
    "time",
    "dt",
    "u_in",
    "u_out",
    "pressure",
    "valid",
    "time_inferred",
)


def test_joined_breaths_are_in_order_and_without_a_source(make):
    one = replace(make(3, optional=True), source="a.csv", sha256="aa", notes=("first",))
    two = replace(make(2, seed=1), source="b.csv", notes=("second", "third"))
    both = join([one, two])
    assert len(both) == 5
    for name in JOINED:
        np.testing.assert_array_equal(getattr(both.select([0, 1, 2]), name), getattr(one, name))
        np.testing.assert_array_equal(getattr(both.select([3, 4]), name), getattr(two, name))
        assert not getattr(both, name).flags.writeable
    assert both.lung_ids.tolist() == [*one.lung_ids, *two.lung_ids]
    assert (both.source, both.sha256, both.flow, both.volume) == (None, None, None, None)
    twice = join([one, one])
    assert one.flow is not None
    assert twice.flow is not None
    np.testing.assert_array_equal(twice.flow, np.concatenate([one.flow, one.flow]))
    assert both.notes == ("first", "second", "third")


def test_join_of_one_recording_leaves_it_as_it_is(make):
    one = replace(make(3, optional=True), source="a.csv")
    alone = join([one])
    np.testing.assert_array_equal(alone.pressure, one.pressure)
    assert one.flow is not None
    assert one.source == "a.csv"


def test_joined_breaths_of_unequal_lengths_are_padded(make):
    long, short = make(2), make(2, samples=6)
    both = join([long, short])
    assert both.valid.sum(axis=1).tolist() == [8, 8, 6, 6]
    np.testing.assert_array_equal(both.pressure[2:, :6], short.pressure)
    np.testing.assert_array_equal(both.u_in[:2], long.u_in)
    with pytest.raises(InputError, match="no recordings to join"):
        join([])


def test_a_folder_is_a_session_whose_recordings_are_joined(make, tmp_path):
    first, other = make(3), make(2, samples=6)
    write(other, tmp_path / "b.csv")
    write(first, tmp_path / "a.csv.gz")
    whole = load(tmp_path)
    assert whole.breath_id.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_array_equal(whole.pressure[:3], first.pressure)
    np.testing.assert_array_equal(whole.u_in[3:, :6], other.u_in)
    assert whole.notes[0] == "Breaths 1 to 3 are those of a.csv.gz."
    (tmp_path / "b.csv").unlink()
    assert load(tmp_path).sha256 == load(tmp_path / "a.csv.gz").sha256
