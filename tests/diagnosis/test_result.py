"""``diagnosis.json`` has the promised keys and is strict JSON."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from ventbench.diagnosis.experiment import never_fitted
from ventbench.diagnosis.findings import OpenLoopError
from ventbench.mechanics.labels import Estimate
from ventbench.plants.catalog import load_simulators
from ventbench.simulation import read_controls

from . import made


def test_the_interface():
    found = made.diagnosis(12)
    plain = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert plain["verdict"] == "named"
    (mechanism,) = plain["mechanisms"]
    assert mechanism["name"] == "valve_delay"
    assert mechanism["parameters"] == {
        "delay": {"value": 0.041, "unit": "s", "ci95": [0.038, 0.044]}
    }
    assert mechanism["confidence"] == 0.97
    assert mechanism["preferred_over_other_names"] == 0.97
    assert mechanism["alternatives"] == ["valve_lag"]
    assert plain["slot"] is None
    assert len(plain["location"]) == len(found.location) > 0
    for place, wanted in zip(plain["location"], found.location, strict=True):
        assert set(place) >= {"axis", "range", "unit", "mean_error", "p_value"}
        assert place["range"] == [wanted.low, wanted.high]
    one = plain["open_loop"]
    assert one["unit"] == "cmH2O"
    assert one["held_out_breaths"] == [3, 6, 9, 12]
    for stage in ("before", "refit", "after"):
        assert set(one[stage]) == {"mae", "rmse"}
    assert one["noise_floor"] == made.NOISE
    assert one["groups"]["first 0.2 s"]["refit"]["rmse"] > 1.0
    assert plain["lung"] == plain["lungs"][0]
    assert set(plain["lung"]) >= {"label", "fitted_R", "fitted_C", "label_matches"}
    assert plain["lung"]["label_matches"] is False
    request = plain["request"]
    assert np.shape(request["u_in"]) == np.shape(request["u_out"]) == np.shape(request["dt"])
    assert plain["sentences"][0].startswith("Missing in the physics simulator")


def test_the_form_of_a_mechanism_is_no_further_effect():
    term = made.unnamed(12).nonparametric
    assert term is not None
    own = dataclasses.replace(term, form_of=("valve_delay",))
    plain = dataclasses.replace(made.diagnosis(12), form=own).as_dict()
    assert plain["slot"] is None
    assert (plain["form"]["of"], plain["form"]["name"]) == (["valve_delay"], "R(V)")
    assert made.diagnosis(12).as_dict()["form"] is None


def test_a_slot_and_nothing():
    slot = made.unnamed(12).as_dict()["slot"]
    assert (slot["name"], slot["explains"]) == ("R(V)", 0.83)
    assert len(slot["shape"]["x"]) == len(slot["shape"]["y"]) == 25
    assert slot["places"] == {}
    plain = made.nothing(12).as_dict()
    assert (plain["mechanisms"], plain["location"], plain["request"]) == ([], [], None)


def test_what_is_not_finite_becomes_null_and_numpy_numbers_are_numbers():
    found = made.diagnosis(12)
    nan = float("nan")
    named = dataclasses.replace(
        found.mechanisms[0],
        parameters={"delay": Estimate(np.float64(0.04), "s", (-np.inf, nan))},
        nats=np.float32(2.5),
        changed=np.bool_(True),
    )
    distances = dataclasses.replace(
        found.open_loop, noise_floor=nan, before=OpenLoopError(nan, 1.0)
    )
    found = dataclasses.replace(found, mechanisms=(named,), open_loop=distances, lungs=())
    plain = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert plain["mechanisms"][0]["parameters"]["delay"]["ci95"] == [None, None]
    assert plain["mechanisms"][0]["nats"] == pytest.approx(2.5)
    assert plain["mechanisms"][0]["changed"] is True
    assert plain["open_loop"]["noise_floor"] is None
    assert plain["open_loop"]["before"] == {"mae": None, "rmse": 1.0}
    assert plain["lung"] is None


def test_a_row_for_each_parameter():
    found = made.diagnosis(12)
    (row,) = found.to_frame().to_dict("records")
    assert (row["mechanism"], row["parameter"], row["unit"]) == ("valve_delay", "delay", "s")
    assert (row["value"], row["ci95_low"], row["ci95_high"]) == (0.041, 0.038, 0.044)
    assert (row["confidence"], row["nats"], row["alternatives"]) == (0.97, 212.0, "valve_lag")
    assert np.isnan(row["simulator_value"])
    changed = dataclasses.replace(
        found.mechanisms[0], changed=True, simulator_values={"delay": 0.012}
    )
    frame = dataclasses.replace(found, mechanisms=(changed,)).to_frame()
    assert frame["simulator_value"].tolist() == [0.012]
    assert list(made.nothing(12).to_frame().columns) == list(frame.columns)


def test_text_and_notebook():
    found = made.diagnosis(12)
    assert str(found).splitlines() == found.as_dict()["sentences"]
    named = dataclasses.replace(found, simulator="<b>mine</b>")
    page = named._repr_html_()
    assert "<table" in page
    assert "valve_delay" in page
    assert "&lt;b&gt;mine&lt;/b&gt;" in page
    assert "<table" not in made.nothing(12)._repr_html_()


def test_files(tmp_path):
    for extra in ("jinja2", "rerun"):
        pytest.importorskip(extra, reason="needs the extra ventbench[view]")
    found = made.diagnosis(12)
    written = found.save(tmp_path / "deep" / "out")
    names = ["diagnosis.json", "report.html", "diagnosis.rrd", "record_next.csv", "corrected.json"]
    assert [path.name for path in written] == names
    assert json.loads(written[0].read_text()) == found.as_dict()
    # Neither corrected plants nor commands of an earlier diagnosis stay behind.
    written = dataclasses.replace(found, plants={}, request=None).save(tmp_path / "deep" / "out")
    assert [path.name for path in written] == names[:3]
    assert sorted(path.name for path in written[0].parent.iterdir()) == sorted(names[:3])


def test_corrected_plants_carry_the_breaths_that_no_fit_has_seen(tmp_path):
    """Fed back with the same recording, the same breaths judge."""
    found = made.diagnosis(12)
    recorded = dataclasses.replace(found.traces.breaths, sha256="a" * 64)
    found = dataclasses.replace(
        found,
        traces=dataclasses.replace(found.traces, breaths=recorded),
        chosen={"R20C50": "after"},
    )
    found.save(tmp_path)
    again = load_simulators(tmp_path / "corrected.json")
    held = list(found.open_loop.held_out_breaths)
    assert again.origin["held_out_breaths"] == held
    assert again.origin["chosen"] == {"R20C50": "after"}
    assert list(never_fitted(recorded, again)) == held
    other = dataclasses.replace(recorded, sha256="b" * 64)
    assert never_fitted(other, again) == ()
    assert never_fitted(recorded, load_simulators("physics")) == ()


def test_the_commands_to_record_next_can_be_played(tmp_path):
    found = made.diagnosis(12)
    request = found.request
    assert request is not None
    path = tmp_path / "record_next.csv"
    path.write_text(request.to_csv())
    (controls,) = read_controls(path)
    assert controls.u_in.shape == (request.u_in.size,)
    np.testing.assert_allclose(controls.u_in, request.u_in.ravel(), atol=1e-4)
    np.testing.assert_array_equal(controls.u_out, request.u_out.ravel())
    np.testing.assert_allclose(controls.dt[:-1], request.dt.ravel()[:-1], atol=2e-6)
    breaths = {line.partition(",")[0] for line in path.read_text().splitlines()[1:]}
    assert breaths == {str(k) for k in range(1, len(request.u_in) + 1)}
