"""The public recordings, where they are present."""

from __future__ import annotations

import numpy as np

from ventbench.recordings import check, load
from ventbench.recordings.foreign import import_runs
from ventbench.recordings.scan import estimated_intervals


def test_the_measured_breaths(public_recordings):
    path = public_recordings / "pvp_quicklung.csv"
    breaths, report = load(path), check(path)
    assert report.ok
    assert not report.warnings
    assert breaths.pressure.shape == (141, 80)
    assert len(report.lungs) == len(breaths.by_lung()) == 9
    assert {11, 22} == {min(report.lungs.values()), max(report.lungs.values())}
    assert report.lungs == {name: len(part) for name, part in breaths.by_lung().items()}
    assert breaths.breath_id[breaths.time_inferred].tolist() == [40, 48, 96, 145, 148, 166]
    assert list(report.time_inferred) == [40, 48, 96, 145, 148, 166]
    assert not np.isnan(breaths.pressure).any()
    assert (breaths.dt > 0.02).all()
    assert (breaths.dt < 0.04).all()
    assert set(breaths.inspiratory.sum(axis=1)) <= set(range(28, 33))
    assert "6 breaths have no times" in breaths.notes[0]


def test_inferred_intervals_are_good(public_recordings):
    breaths = load(public_recordings / "pvp_quicklung.csv")
    known = ~breaths.time_inferred
    interval = breaths.time[known, -1] / 79
    count = breaths.inspiratory[known].sum(axis=1)
    off = []
    for i, dt in enumerate(interval):
        others = np.where(np.arange(len(count)) == i, np.nan, interval)
        off.append(abs(estimated_intervals(count, others, np.full(len(count), 80))[i] - dt))
    assert np.median(off) < 0.13e-3
    assert np.quantile(off, 0.9) < 0.4e-3


def test_the_reconstructed_breaths(public_recordings):
    path = public_recordings / "pvp_quicklung_reconstructed.csv"
    breaths, report = load(path), check(path)
    assert len(breaths) == 599
    assert int(np.isfinite(breaths.pressure).sum()) == 13_013
    assert report.blank_pressures == 599 * 80 - 13_013
    assert not breaths.time_inferred.any()


def test_respiraworks(public_recordings):
    path = public_recordings / "respiraworks_quicklung.parquet"
    assert "missing columns id, breath_id, u_in, u_out" in str(check(path).problems[0])
    runs = import_runs(path)
    assert len(runs) == 48
    for breaths in runs.values():
        inside = breaths.valid[:, 1:]
        assert abs(np.diff(breaths.time)[inside] - 0.01).max() < 1e-6
