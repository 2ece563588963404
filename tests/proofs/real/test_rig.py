"""The proof on real recordings, around diagnoses that are made up."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from proofs.__main__ import app
from proofs.cli import real as command
from proofs.real import rig
from proofs.real.parts import (
    FEW,
    LAG,
    PARTS,
    by_names_alone,
    lagged,
    most_important,
    slower_sensor,
    without,
)
from proofs.real.rig import RECORDING, claims, cut, figures, prove
from tests.diagnosis import made
from ventbench.base import compilation, files
from ventbench.base.errors import InputError
from ventbench.diagnosis.findings import OpenLoopError
from ventbench.diagnosis.result import Diagnosis
from ventbench.physics import physics
from ventbench.plants.corrected import Corrected
from ventbench.plants.plant_files import save_plants
from ventbench.recordings import join, write
from ventbench.task.lungs import LUNG_IDS, LUNGS, lung

SAVE = Diagnosis.save


def keep(found: Diagnosis, out: Path) -> list[Path]:
    files.write_json(out / "diagnosis.json", found.as_dict())
    save_plants(out / "corrected.json", found.plants)
    return [out / "diagnosis.json", out / "corrected.json"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> Path:
    """A folder with four breaths of each lung, and of one that the proof leaves out."""
    folder = tmp_path_factory.mktemp("recordings")
    parts = []
    for i, name in enumerate((*LUNG_IDS, "R50C20")):
        some = made.breaths(name, n=4, seed=i)
        parts.append(dataclasses.replace(some, breath_id=some.breath_id + 100 * i))
    write(join(parts), folder / RECORDING)
    return folder


class Diagnoses:
    """Stands for the diagnosis: names ``answers`` in turn, and remembers what it was asked."""

    def __init__(self, names: tuple[str, ...] = ("valve_delay",)) -> None:
        self.names = names
        self.asked: list[dict[str, Any]] = []

    def __call__(self, breaths, *, simulator, patient, progress) -> Diagnosis:
        assert not patient  # nobody breathed on the rig
        self.asked.append({"breaths": breaths, "plant": simulator})
        progress("fitting", 0.5)
        one = made.diagnosis(12)
        named = tuple(dataclasses.replace(one.mechanisms[0], name=name) for name in self.names)
        with compilation.float64():
            plants = {
                item.id: physics(item, {"valve_delay": {"delay": 0.04}, "leak": {"conductance": 2}})
                for item in LUNGS
            }
        return dataclasses.replace(one, mechanisms=named, plants=plants)


@pytest.fixture
def diagnoses(monkeypatch: pytest.MonkeyPatch) -> Diagnoses:
    """What stands for the diagnosis; without pictures."""
    fake = Diagnoses()
    monkeypatch.setattr(rig, "diagnose", fake)
    monkeypatch.setattr(Diagnosis, "save", keep)
    return fake


def test_the_lag_of_a_step_and_of_a_ramp():
    time = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.05, 60)) - 0.02
    ramp = 3.0 * time
    shown = lagged(time, ramp, 0.08)
    # A ramp is followed 0.08 s late once the beginning has died away.
    since = time - time[0]
    np.testing.assert_allclose(shown, ramp - 0.24 * (1.0 - np.exp(-since / 0.08)), atol=1e-12)
    held = np.where(np.arange(60) < 20, 5.0, 25.0)
    step = lagged(time, held, 0.08)
    np.testing.assert_array_equal(step[:20], 5.0)
    gone = np.exp(-(time[21:] - time[20]) / 0.08)
    np.testing.assert_allclose(25.0 - step[21:], (25.0 - step[20]) * gone, atol=1e-12)


def test_the_lag_against_fine_steps_with_a_gap():
    rng = np.random.default_rng(1)
    time = np.concatenate([[0.0], np.cumsum(rng.uniform(0.03, 0.035, 39))])
    pressure = 5.0 + 10.0 * rng.random(40)
    pressure[[0, 11, 12, 39]] = np.nan
    known = np.isfinite(pressure)
    fine = np.linspace(time[1], time[38], 400_001)
    straight = np.interp(fine, time[known], pressure[known])
    y, slow = straight[0], []
    for p in straight:
        slow.append(y)
        y += (fine[1] - fine[0]) / LAG * (p - y)
    shown = lagged(time, pressure, LAG)
    np.testing.assert_array_equal(np.isfinite(shown), known)
    np.testing.assert_allclose(shown[known], np.interp(time[known], fine, slow), atol=2e-3)
    assert np.isnan(lagged(time, np.full(40, np.nan), LAG)).all()


def test_only_pressures_are_changed():
    before = made.breaths(n=3)
    after = slower_sensor(before, LAG)
    assert after.u_in is before.u_in
    np.testing.assert_array_equal(after.pressure[:, 0], before.pressure[:, 0])
    assert np.abs(after.pressure - before.pressure)[:, 1:].max() > 2.0


def test_what_is_removed_does_nothing():
    both = {"valve_delay": {"delay": 0.04}, "exhalation_valve_delay": {"opening": 0.03}}
    with compilation.float64():
        plant = physics(lung("R20C50"), both)
        less = without(plant, ("valve_delay",))
    assert float(less.get("valve_delay.delay")) == 0.0
    assert float(less.get("exhalation_valve_delay.opening")) == 0.03
    assert float(less.get("R")) == 20.0
    assert float(plant.get("valve_delay.delay")) == 0.04


def test_the_most_important_is_no_patients_effort():
    effort, delay = {"name": "patient_effort"}, {"name": "valve_delay"}
    assert most_important([effort, delay, {"name": "leak"}]) == "valve_delay"
    assert most_important([effort]) is None
    assert most_important([]) is None


def test_by_names_alone_leaves_the_names():
    with compilation.float64():
        named = physics(lung("R5C10"), {"valve_delay": {"delay": 0.04}})
        both = named.having(**{"valve_shape.c1": 0.5})
    assert by_names_alone(named) is named
    alone = by_names_alone(both)
    assert float(alone.get("valve_shape.c1")) == 0.0  # type: ignore[attr-defined]
    assert float(alone.get("valve_delay.delay")) == 0.04  # type: ignore[attr-defined]
    with compilation.float64():
        own = named.having(**{"valve_shape.c1": 0.2, "supply_memory.c1": 0.3})
    corrected = Corrected(named, both, own)
    less: Any = by_names_alone(corrected)
    assert float(less.with_mechanisms.get("valve_delay.delay")) == 0.04
    for path, value in {"valve_shape.c1": 0.2, "supply_memory.c1": 0.3}.items():
        assert float(less.with_mechanisms.get(path)) == pytest.approx(value), (
            "it is the simulator's own"
        )
        assert less.without_mechanisms.get(path) == less.with_mechanisms.get(path), (
            "and makes no difference"
        )
    none: Any = by_names_alone(Corrected(named, both, named))
    assert float(none.with_mechanisms.get("valve_shape.c1")) == 0.0


def test_all_parts_and_once_only(recordings, tmp_path, diagnoses):
    told: list[tuple[str, str, float]] = []
    found = prove(recordings, tmp_path, progress=lambda *x: told.append(x))
    assert (
        list(found.parts) == list(PARTS) == ["rc", "two_balloon", "removed", "injected", "frozen"]
    )
    assert told == [(name, "fitting", 0.5) for name in PARTS]
    six, balloons, removed, injected, frozen = diagnoses.asked
    assert list(six["breaths"].by_lung_index) == list(LUNG_IDS)
    assert six["plant"] == "physics"
    assert float(balloons["plant"]["R20C50"].C) == 50.0
    assert balloons["plant"]["R20C50"].gain == 22.8
    assert set(removed["breaths"].lung_ids.tolist()) == set(FEW)
    assert float(removed["plant"]["R20C50"].get("valve_delay.delay")) == 0.0
    assert float(removed["plant"]["R20C50"].get("leak.conductance")) == 2.0
    assert (injected["plant"], frozen["plant"]) == ("frozen", "frozen")
    raw = frozen["breaths"]
    want = slower_sensor(raw, 0.08).pressure
    np.testing.assert_array_equal(injected["breaths"].pressure, want)
    assert json.loads((tmp_path / "rc" / "diagnosis.json").read_text())["plant"] == "physics"
    plain = json.loads((tmp_path / "removed" / "diagnosis.json").read_text())
    assert plain["plant"] == "corrected R-C without valve_delay"
    assert json.loads((tmp_path / "proof.json").read_text()) == found.as_dict()
    assert str(recordings) not in (tmp_path / "proof.json").read_text()
    again = prove(recordings, tmp_path)
    assert len(diagnoses.asked) == 5
    assert again.as_dict() == found.as_dict()


def test_what_changed_is_done_again(recordings, tmp_path, diagnoses):
    prove(recordings, tmp_path, ["rc", "removed"])
    assert len(diagnoses.asked) == 2
    (tmp_path / "rc" / "diagnosis.json").unlink()  # as if it had been stopped there
    diagnoses.names = ("leak", "valve_delay")
    found = prove(recordings, tmp_path)
    assert found.parts["removed"]["wanted"] == "leak"
    assert found.parts["removed"]["about"]["removed"] == "leak"
    assert len(diagnoses.asked) == 7, "rc, removed since rc was, and the other three"


def test_a_part_that_was_stopped_does_not_count(recordings, tmp_path, diagnoses, monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    prove(recordings, tmp_path, ["rc"])
    monkeypatch.setattr(rig, "diagnose", stopped)
    with pytest.raises(KeyboardInterrupt):
        prove(recordings, tmp_path)
    monkeypatch.setattr(rig, "diagnose", diagnoses)
    proof = prove(recordings, tmp_path, ["frozen"])
    assert list(proof.parts) == ["rc", "frozen"]
    assert len(diagnoses.asked) == 2


def test_bad_requests(recordings, tmp_path, diagnoses):
    with pytest.raises(InputError, match=r"no part 'all' in the proof; choose of rc, two_balloon"):
        prove(recordings, tmp_path, ["all"])
    with pytest.raises(InputError, match="removed starts from the part rc"):
        prove(recordings, tmp_path, ["removed"])
    with pytest.raises(InputError, match="there is no such file"):
        prove(tmp_path, tmp_path)
    assert diagnoses.asked == []


def test_nothing_to_remove_is_a_claim_that_fails(recordings, tmp_path, diagnoses):
    diagnoses.names = ("patient_effort",)
    found = prove(recordings, tmp_path, ["rc", "removed"])
    assert "nothing to remove" in found.impossible["removed"]
    assert [claim.met for claim in found.claims if claim.part == "removed"] == [False]
    assert not found.met
    assert len(diagnoses.asked) == 1


def test_claims_are_computed():
    tau = {"tau": {"value": 0.1, "unit": "s", "ci95": [0.09, 0.11]}}
    lag = {"name": "sensor_lag", "parameters": tau, "alternatives": []}
    good = {
        "rc": {"cut_percent": 70.0},
        "injected": {"wanted": "sensor_lag", "mechanisms": [lag]},
        "frozen": {"mechanisms": []},
    }
    cut_, injected = claims(good, {})
    assert (cut_.met, injected.met) == (True, True)
    assert injected.value == "tau 0.1 s [0.09, 0.11]; without injection not named"
    valve = lag | {"name": "valve_lag", "alternatives": ["sensor_lag"]}
    bad = good | {
        "rc": {"cut_percent": 69.9},
        "injected": {"wanted": "sensor_lag", "mechanisms": [valve]},
        "frozen": {"mechanisms": [lag]},
    }
    cut_, injected = claims(bad, {})
    assert (cut_.met, injected.met) == (False, False)
    start = "not named; named: valve_lag (or sensor_lag); without injection tau 0.1 s"
    assert injected.value.startswith(start)
    assert [claim.met for claim in claims({"rc": {"cut_percent": None}}, {})] == [False]
    for after, met in ((0.7, True), (0.8, False)):
        lungs = {"lung R5C10": {"refit": {"mae": 0.7}, "after": {"mae": after}}, "expiration": {}}
        _, worse = claims({"rc": {"cut_percent": 70.0, "groups": lungs}}, {})
        assert (worse.met, "R5C10" in worse.value) == (met, not met)
    assert claims({}, {}) == []
    assert cut(5.0, 2.0) == pytest.approx(60.0)
    assert cut(None, 2.0) is None


@pytest.mark.usefixtures("diagnoses")
def test_the_unnamed_part_does_not_count_for_the_cut(recordings, tmp_path, monkeypatch):
    """Its plants are simulated again without it; here names alone are as bad as the start."""
    one = made.diagnosis(12)
    start = physics(lung("R20C50"))
    with compilation.float64():
        plant = start.having(**{"valve_shape.c1": 0.5})
    after = OpenLoopError(0.2, 0.3)
    loop = dataclasses.replace(one.open_loop, after=after)
    diagnosis = dataclasses.replace(one, open_loop=loop, plants={"R20C50": plant})
    monkeypatch.setattr(rig, "diagnose", lambda *_, **__: diagnosis)
    found = prove(recordings, tmp_path, ["rc"])
    part = found.parts["rc"]
    assert part["mae"]["after"] == 0.2
    assert part["mae_by_names_alone"] == pytest.approx(one.open_loop.before.mae, rel=0.1)
    assert abs(part["cut_percent"]) < 10.0
    assert not found.met
    kept, summary = (
        json.loads((tmp_path / "rc" / f"{name}.json").read_text()) for name in ("diagnosis", "part")
    )
    assert figures(kept, summary)["cut_percent"] == part["cut_percent"]
    assert figures(kept | {"mechanisms": []}, summary)["cut_percent"] is None  # names do nothing


@pytest.fixture
def _tried(monkeypatch: pytest.MonkeyPatch, diagnoses: Diagnoses) -> None:
    pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")
    pytest.importorskip("rerun", reason="needs the extra ventbench[view]")
    monkeypatch.setenv("VENTBENCH_CACHE", "")  # nothing of JAX is configured
    monkeypatch.setattr(Diagnosis, "save", SAVE)


@pytest.mark.usefixtures("_tried")
def test_the_command(recordings, tmp_path, diagnoses):
    arguments = ["rig", "--recordings", str(recordings), "--out", str(tmp_path), "--only", "rc"]
    ran = CliRunner().invoke(app, [*arguments, "--json", "-"])
    plain = json.loads(ran.stdout)
    met = plain["parts"]["rc"]["cut_percent"] >= 60.0
    assert ran.exit_code == (0 if met else 1)
    assert plain["met"] is met
    assert sorted(p.name for p in (tmp_path / "rc").iterdir()) == [
        "corrected.json",
        "diagnosis.json",
        "diagnosis.rrd",
        "part.json",
        "record_next.csv",
        "report.html",
    ]
    assert all(name in str(command.rig.__annotations__["only"]) for name in PARTS)


@pytest.mark.usefixtures("_tried")
def test_exit_codes_follow_the_claims(recordings, tmp_path, diagnoses, monkeypatch):
    own = ["rig", "--recordings", str(recordings), "--out", str(tmp_path)]
    arguments = [*own, "--only", "frozen"]
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.output
    assert "error of held-out inspirations" in ran.stdout
    ran = CliRunner().invoke(app, [*arguments[:-1], "injected"])
    assert ran.exit_code == 1
    assert "| sensor_lag is named | not named; named: valve_delay" in ran.stdout
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ventbench.recordings.recordings_dir", lambda: None)
    ran = CliRunner().invoke(app, ["rig", "--out", "proof"])
    assert isinstance(ran.exception, InputError)
    assert "give --recordings DIR" in str(ran.exception)
