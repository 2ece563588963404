"""Blank times: interpolated within a breath, inferred for a whole one, and reported."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ventbench.recordings import check, load
from ventbench.recordings.scan import estimated_intervals

TIME = 4


def test_single_blank_times_are_interpolated(rows, write_csv):
    for k in (7, 8):
        rows[k][TIME] = ""
    for k in (12, 17):
        rows[k][TIME] = "NaN"
    path = write_csv(rows)
    breaths = load(path)
    np.testing.assert_allclose(breaths.time, np.tile(0.25 * np.arange(6), (3, 1)), atol=1e-15)
    assert (breaths.time[:, 0] == 0.0).all()
    assert not breaths.time_inferred.any()
    assert check(path).time_interpolated == 4
    assert "4 single blank times were interpolated." in breaths.notes


def test_a_breath_without_times_takes_the_median_of_its_like(write_csv):
    dts = {1: 0.26, 2: 0.24, 3: 0.25, 4: None, 5: None}
    rows = []
    for breath, dt in dts.items():
        switch = 3 if breath == 5 else 4
        for i in range(6):
            time = "" if dt is None else repr(i * dt)
            cells = (len(rows), breath, 5, 10, time, 1.0, int(i >= switch), 5.0)
            rows.append([str(cell) for cell in cells])
    path = write_csv(rows)
    breaths = load(path)
    np.testing.assert_array_equal(breaths.time_inferred, [False, False, False, True, True])
    np.testing.assert_allclose(breaths.time[3], 0.25 * np.arange(6))
    np.testing.assert_allclose(breaths.time[4], np.arange(6) / 3)
    report = check(path)
    assert report.time_inferred == {4: pytest.approx(0.25), 5: pytest.approx(1 / 3)}
    assert "2 breaths have no times" in report.notes()[0]
    assert any("breath 4: 250.0 ms" in line for line in report.lines())
    assert json.loads(json.dumps(report.to_dict()))["time_inferred"]["5"] == pytest.approx(1 / 3)


def test_one_known_time_counts_as_none(rows, write_csv):
    for k in (1, 2, 3, 4, 5):
        rows[k][TIME] = ""
    breaths = load(write_csv(rows))
    assert breaths.time_inferred.tolist() == [True, False, False]


def test_times_are_moved_to_start_at_zero(rows, write_csv):
    for row in rows[6:12]:
        row[TIME] = str(float(row[TIME]) + 100.0)
    path = write_csv(rows)
    assert (load(path).time[:, 0] == 0.0).all()
    assert check(path).time_shifted == 1
    np.testing.assert_array_equal(load(path).time[1], load(path).time[0])


def test_intervals_are_those_of_breaths_alike():
    n = np.array([31, 31, 31, 29, 29, 30, 0, 80])
    interval = np.array([0.031, 0.032, 0.033, 0.034, 0.035, np.nan, np.nan, np.nan])
    found = estimated_intervals(n, interval, np.full(8, 80))
    wanted = [0.032] * 3 + [1 / 29] * 2 + [1 / 30] + [0.033] * 2
    np.testing.assert_array_equal(found, wanted)
    assert np.isnan(estimated_intervals(n, np.full(8, np.nan), np.full(8, 80))[-1])
