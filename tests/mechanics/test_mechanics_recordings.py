"""Mechanics of the RespiraWorks recordings, and how their runs become breaths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from ventbench import mechanics
from ventbench.mechanics import RespiraWorksRun, load_respiraworks


@pytest.fixture(scope="module")
def surveyed(public_recordings):
    return mechanics.survey(public_recordings / "respiraworks_quicklung.parquet")


def test_a_run_becomes_breaths():
    time = np.arange(1000) * 0.01
    breath = np.repeat([0, 1, 2, 3], [30, 400, 500, 70])
    target = np.where((time % 4) < 1, 30.0, 5.0)
    signals = {name: np.full(1000, np.nan) for name in ("flow", "volume")}
    signals |= {"pressure": time, "target": target, "volume": 10.0 * time}
    run = RespiraWorksRun("day", 1, "blower", 20.0, 50.0, breath, time, signals)
    breaths = mechanics.breaths_of(run)
    # Cut 0.25 s before each breath, so that the steep rise lies within; the stub is left out.
    assert breaths.breath_id.tolist() == [1, 2, 3]
    assert breaths.valid.sum(axis=1).tolist() == [400, 500, 95]
    assert breaths.pressure[1, 0] == pytest.approx(4.05)
    assert breaths.time[:, 0].tolist() == [0.0, 0.0, 0.0]
    assert breaths.flow is None
    assert breaths.volume is not None
    assert breaths.lung_ids.tolist() == ["R20C50"] * 3
    np.testing.assert_array_equal(breaths.u_out[0][breaths.valid[0]], target[5:405] < 17.5)


def test_the_lungs_are_what_their_labels_say(surveyed):
    known = [one for one in surveyed if one.mechanics is not None]
    assert len(surveyed) == 48
    assert len(known) == 40
    assert {one.run.name for one in surveyed if one.mechanics is None} == {
        "2020-07-01-Control-Tests-AIR"
    }
    good = [one for one in known if one.mechanics.match.label_matches]
    assert len(good) >= 32
    for one in good:
        assert one.mechanics.match.settings[0] == one.mechanics.label
    # Wherever the label does not hold, no wrong setting is claimed without a warning.
    for one in known:
        if one not in good and one.mechanics.match.settings:
            assert one.mechanics.notes


def test_the_resistors_are_parabolic(surveyed):
    """R20 lungs with a steady pressure: 20 at 1 L/s, about 6 at small flow."""
    found = [
        one.mechanics for one in surveyed
        if one.mechanics is not None and one.run.R == 20.0 and one.mechanics.noise < 0.5
    ]  # fmt: skip
    bent = [one for one in found if "turbulent_resistance" in [term.name for term in one.terms]]
    assert len(bent) >= 0.7 * len(found)
    assert len(found) >= 10
    at_1 = [one.match.fitted_R for one in bent]
    assert np.median(at_1) == pytest.approx(19.0, abs=1.5)
    assert np.median([one.R.value for one in bent]) < 10.0


def test_another_label_is_refused(public_recordings):
    """Each clean run with the label of the next R and C: never accepted, and the true one named."""
    other = {5.0: 20.0, 20.0: 50.0, 50.0: 5.0}
    runs = load_respiraworks(public_recordings / "respiraworks_quicklung.parquet")
    tried = 0
    for run in (r for r in runs if r.name == "2020-06-17-covent-tests-QuickLung" and r.test < 6):
        wrong = replace(run, R=other[run.R])
        (found,) = mechanics.identify(mechanics.breaths_of(wrong))
        assert not found.match.label_matches
        assert found.settings[0].id == f"R{run.R:g}C{run.C:g}"
        tried += 1
    assert tried == 5


def test_a_table_has_a_line_a_run(public_recordings, tmp_path):
    table = pd.read_parquet(public_recordings / "respiraworks_quicklung.parquet")
    without, clean = "2020-07-01-Control-Tests-AIR", "2020-06-17-covent-tests-QuickLung"
    few = table[(table["run"] == without) | ((table["run"] == clean) & (table["test"] == 1))]
    few.to_parquet(tmp_path / "few.parquet")
    lines = mechanics.survey_table(mechanics.survey(tmp_path / "few.parquet")).splitlines()
    assert len(lines) == 2 + 9
    assert sum("no flow, no volume" in line for line in lines) == 8
    assert all(line.count("|") == 9 for line in lines)


def test_the_table(surveyed):
    lines = mechanics.survey_table(surveyed).splitlines()
    assert len(lines) == 50
    assert sum("no flow, no volume" in line for line in lines) == 8
    assert all(line.count("|") == 9 for line in lines)
