"""``ventbench diagnose`` around a diagnosis that is made up; ``--simulator FILE`` elsewhere."""

from __future__ import annotations

import dataclasses
import json
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.cli import diagnose as command
from ventbench.plants.plant_files import load_plants
from ventbench.plants.python_simulators import PythonSimulators
from ventbench.plants.simulators import SimulatedPressures
from ventbench.recordings import write

from . import made

pytest.importorskip("jinja2", reason="needs the extra ventbench[view]")
pytest.importorskip("rerun", reason="needs the extra ventbench[view]")

FILES = ["corrected.json", "diagnosis.json", "diagnosis.rrd", "record_next.csv", "report.html"]

app = typer.Typer()
app.command()(command.diagnose)


def run(*arguments: object, code: int = 0) -> str:
    found = CliRunner().invoke(app, [*map(str, arguments)])
    if isinstance(found.exception, InputError | OSError):  # main() prints it and exits with 2
        assert code == 2
        return str(found.exception)
    assert found.exit_code == code, found.output
    return found.stdout


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Arguments of each diagnosis, which is the same made-up one every time."""
    seen: list[dict[str, Any]] = []

    def diagnose(breaths, *, simulator, lung, patient, drive, progress):
        progress("fitting", 0.5)
        seen.append(
            {
                "breaths": breaths,
                "simulator": simulator,
                "lung": lung,
                "patient": patient,
                "drive": drive,
            }
        )
        return made.diagnosis(12)

    module = types.ModuleType("ventbench.diagnosis.diagnose")
    module.diagnose = diagnose  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return seen


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Breaths of two lungs."""
    from ventbench.recordings import join

    path = tmp_path / "lab.csv"
    other = made.breaths("R5C10", n=4, seed=3)
    other = dataclasses.replace(other, breath_id=other.breath_id + 100)
    write(join([made.breaths(n=6), other]), path)
    return path


def test_files_and_the_words(recording, tmp_path, calls):
    out = tmp_path / "deep" / "out"
    text = run(recording, "--lung", "R20C50", "--out", out)
    assert sorted(item.name for item in out.iterdir()) == FILES
    assert (calls[0]["simulator"].name, calls[0]["lung"]) == ("physics", "R20C50")
    assert not calls[0]["patient"]
    words = " ".join(text.split())
    assert words.startswith("Missing in the physics simulator: dead time of the inspiratory valve")
    assert "Dead time of the inspiratory valve (valve_delay): 41 ms [38, 44];" in words
    for name in FILES:
        assert str(out / name) in text.replace("\n", "")
    plain = json.loads((out / "diagnosis.json").read_text())
    assert plain["verdict"] == "named"
    again = run(recording, "--out", out)
    assert again.splitlines()[0] == text.splitlines()[0]
    assert calls[1]["lung"] is None
    assert not calls[1]["patient"]
    session = tmp_path / "session"  # as `ventbench-hardware run` leaves it
    session.mkdir()
    write(made.breaths(n=6), session / "recording.csv.gz")
    run(session, "--out", out)
    assert len(calls.pop()["breaths"]) == 6
    run(recording, "--patient", "--out", out)
    assert calls[2]["patient"]
    assert len(calls[1]["breaths"]) == 10
    assert sorted(item.name for item in out.iterdir()) == FILES, "written over, nothing left behind"


def test_json_to_stdout_is_nothing_else(recording, tmp_path, calls):
    out = tmp_path / "out"
    plain = json.loads(run(recording, "--out", out, "--json", "-"))
    assert plain == json.loads((out / "diagnosis.json").read_text())


def test_bad_input(recording, tmp_path, calls):
    out = tmp_path / "out"
    assert "no such file" in run(tmp_path / "none.csv", "--out", out, code=2).lower()
    message = run(recording, "--simulator", "phisics", "--out", out, code=2)
    assert "--simulator 'phisics': there is no such file" in message
    other = tmp_path / "other.json"
    other.write_text("{}")
    assert "is not a file of plants" in run(recording, "--simulator", other, "--out", out, code=2)
    assert calls == []
    assert not out.exists()
    assert "--out DIR is needed" in run(recording, code=2)


def test_the_corrected_plant_can_be_diagnosed_itself(recording, tmp_path, calls):
    out = tmp_path / "out"
    run(recording, "--lung", "R20C50", "--out", out)
    corrected = out / "corrected.json"
    found, _ = load_plants(corrected)
    assert list(found) == ["R20C50"]
    run(recording, "--lung", "R20C50", "--simulator", corrected, "--out", tmp_path / "again")
    given = calls[-1]["simulator"]
    assert given.name == "corrected.json"
    assert [lung.id for lung in given.lungs] == ["R20C50"]
    assert float(given.plant("R20C50").get("valve_delay.delay")) == 0.041
    np.testing.assert_array_equal(found["R20C50"].get("R"), 22.1)  # type: ignore[attr-defined]


def test_simulated_pressures_and_drive(recording, tmp_path, calls):
    """A table of simulated pressures is a plant; --drive is passed on."""
    import pandas as pd

    table = pd.read_csv(recording)
    table["simulated"] = table.pressure + 1.0
    both = tmp_path / "both.csv"
    table.to_csv(both, index=False)
    out = tmp_path / "out"
    run(both, "--simulator", both, "--drive", "valve", "--out", out)
    given = calls[0]["simulator"]
    assert (type(given), given.name) == (SimulatedPressures, "both.csv")
    assert calls[0]["drive"] == "valve"
    breaths = calls[0]["breaths"]
    np.testing.assert_allclose(given.pressures(breaths), breaths.pressure + 1.0, atol=1e-6)
    assert "choose auto, valve or flow" in run(both, "--drive", "gas", "--out", out, code=2)


def test_a_simulator_in_plain_python(recording, tmp_path, calls, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plain_lungs.py").write_text(
        "class Lung:\n"
        "    def reset(self, initial_pressure):\n"
        "        self.p = initial_pressure\n"
        "    def step(self, u_in, u_out, dt):\n"
        "        self.p += 0.1 * u_in * dt\n"
        "        return self.p\n"
    )
    run(recording, "--simulator", "plain_lungs:Lung", "--out", tmp_path / "out")
    given = calls[0]["simulator"]
    assert (type(given), given.name) == (PythonSimulators, "plain_lungs:Lung")
    assert np.isfinite(given.pressures(calls[0]["breaths"])).all()


def test_it_says_how_long_it_will_take():
    assert "usually 10 s to a minute. Ctrl-C" in command.expected_time(24, 1, warm=True)
    assert "half a minute more" in command.expected_time(24, 6, warm=False)


def test_steps_of_unknown_number_advance_and_stay_below_their_end():
    from ventbench.diagnosis.diagnose import steps_between

    told: list[tuple[str, float]] = []
    step = steps_between(lambda what, share: told.append((what, share)), 0.1, 0.6)
    for k in range(12):
        step(f"step {k}")
    shares = [share for _, share in told]
    assert shares[0] == 0.1
    assert shares == sorted(set(shares))
    assert 0.5 < shares[-1] < 0.6
