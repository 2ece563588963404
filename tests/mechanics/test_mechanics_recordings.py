"""Mechanics of the RespiraWorks recordings."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from proofs.real.pairs import with_leak
from ventbench import mechanics
from ventbench.cli import app
from ventbench.recordings.foreign import import_runs


@pytest.fixture(scope="module")
def surveyed(public_recordings, tmp_path_factory) -> list[dict[str, Any]]:
    """What the command says of each run with flow or volume."""
    target = tmp_path_factory.mktemp("lungs") / "lungs.json"
    path = public_recordings / "respiraworks_quicklung.parquet"
    found = CliRunner().invoke(app, ["mechanics", str(path), "--json", str(target)])
    assert found.exit_code == 0, found.output
    assert "8 of 48 runs have neither flow nor volume" in found.stderr
    return json.loads(target.read_text())


def test_the_lungs_are_what_their_labels_say(surveyed):
    assert len(surveyed) == 40
    assert not any("2020-07-01-Control-Tests-AIR" in one["name"] for one in surveyed)
    good = [one for one in surveyed if one["match"]["label_matches"]]
    assert len(good) >= 36
    for one in good:
        assert one["settings"][0] == one["label"]
    # Wherever the label does not hold, no wrong setting is claimed without a warning.
    for one in surveyed:
        if one not in good and one["settings"]:
            assert one["notes"]


def test_the_resistors_are_parabolic(surveyed):
    """R20 lungs with a steady pressure: 20 at 1 L/s, about 6 at small flow."""
    found = [one for one in surveyed if one["label"].startswith("R20") and one["noise"] < 0.5]
    bent = [
        one for one in found if "turbulent_resistance" in [term["name"] for term in one["terms"]]
    ]
    assert len(bent) >= 0.7 * len(found)
    assert len(found) >= 10
    at_1 = [one["match"]["fitted_R"] for one in bent]
    assert np.median(at_1) == pytest.approx(19.0, abs=1.5)
    assert np.median([one["R"]["value"] for one in bent]) < 10.0


def test_another_label_is_refused(public_recordings):
    """Each clean run with the label of the next R and C: never accepted, and the true one named."""
    other = {5.0: 20.0, 20.0: 50.0, 50.0: 5.0}
    runs = import_runs(public_recordings / "respiraworks_quicklung.parquet")
    for test in range(1, 6):
        breaths = runs[f"2020-06-17-covent-tests-QuickLung {test}"]
        wrong = np.full(len(breaths), other[breaths.R[0]])
        (found,) = mechanics.identify(replace(breaths, R=wrong))
        assert not found.match.label_matches
        assert found.match.settings[0] == breaths.lung_ids[0]


def test_an_added_leak_is_named_and_brings_no_other_name(public_recordings):
    """4 mL/s per cmH2O behind the sensor of real runs, one of each lung and day."""
    runs = import_runs(public_recordings / "respiraworks_quicklung.parquet")
    chosen = [name for name in sorted(runs)[::3] if runs[name].volume is not None]
    assert len(chosen) >= 10
    named, others = [], []
    for name in chosen:
        before, after = (
            {term.name: term for term in mechanics.identify(breaths)[0].terms}
            for breaths in (runs[name], with_leak(runs[name], 4.0))
        )
        others += sorted(set(after) - set(before) - {"leak"})
        if "leak" in after:
            named.append(after["leak"].parameters["conductance"].value)
    assert len(named) >= 0.8 * len(chosen)
    assert len(others) <= 0.1 * len(chosen)
    assert np.median(named) == pytest.approx(4.0, abs=0.2)
