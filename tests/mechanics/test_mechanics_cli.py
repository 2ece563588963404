"""``ventbench mechanics``."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest
import typer
from typer.testing import CliRunner

from tests.diagnosis import made
from ventbench.base.errors import InputError
from ventbench.cli import diagnose as command
from ventbench.mechanics import identify
from ventbench.recordings import Breaths, join, load, write

app = typer.Typer()
app.command()(command.mechanics)


def run(*arguments: object, code: int = 0) -> str:
    found = CliRunner().invoke(app, [*map(str, arguments)], terminal_width=200)
    if isinstance(found.exception, InputError | OSError):  # main() prints it and exits with 2
        assert code == 2, found.exception
        return str(found.exception)
    assert found.exit_code == code, found.output
    return found.stdout


def recorded(label: str, *, flow: bool = True) -> Breaths:
    """Breaths of a lung that is what its label says, with flow."""
    breaths = made.breaths(label, n=6, samples=90)
    R, C = breaths.R[0], breaths.C[0]
    inputs = (breaths.u_in, np.asarray(breaths.u_out), breaths.dt)
    pressure, measured, _ = made.answer(*inputs, R, C)
    noise = 0.05 * np.random.default_rng(2).standard_normal(pressure.shape)
    return replace(breaths, pressure=pressure + noise, flow=measured if flow else None)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    first, other = recorded("R20C50"), recorded("R5C20")
    other = replace(other, breath_id=other.breath_id + 100)
    flow = np.concatenate([x.flow for x in (first, other) if x.flow is not None])
    write(replace(join([first, other]), flow=flow), tmp_path / "lab.csv")
    return tmp_path / "lab.csv"


def test_what_a_lung_needs_is_told_with_its_size_and_its_rival(tmp_path):
    plain = recorded("R20C20")
    assert plain.flow is not None
    write(replace(plain, flow=plain.flow + 5.0 * plain.pressure), tmp_path / "leak.csv")
    text = run(tmp_path / "leak.csv")
    found = re.search(
        r"R20C20 needs beyond R and C: leak or flow_sensor_zero \(conductance (\S+) mL/s per "
        r"cmH2O \[(\S+), (\S+)\], zero (\S+) mL/s \[\S+, \S+\]\)",
        " ".join(text.split()),
    )
    assert found is not None, text
    value, low, high, zero = map(float, found.groups())
    assert zero == pytest.approx(value * np.nanmean(plain.pressure), rel=0.1)
    assert low < 5.0 < high
    assert abs(value - 5.0) < 0.5


def test_lungs_of_the_public_schema(recording, tmp_path):
    target = tmp_path / "lungs.json"
    text = run(recording, "--json", target)
    assert "R5C20" in text
    assert "R20C50" in text
    small, large = json.loads(target.read_text())
    assert (small["label"], large["label"]) == ("R5C20", "R20C50")
    assert large["match"]["label_matches"] is True
    assert large["settings"][0] == "R20C50"
    assert large["C"]["value"] == pytest.approx(50.0, rel=0.1)
    assert large["match"]["fitted_R"] == pytest.approx(20.0, rel=0.15)
    assert json.loads(run(recording, "--json", "-")) == [small, large]


def test_progress_counts_breaths_lung_by_lung(recording):
    told = []
    identify(load(recording), lambda *counts: told.append(counts))
    assert told == [(6, 12), (12, 12)]


def test_another_label_is_said_so(tmp_path):
    breaths = recorded("R20C50")
    write(replace(breaths, C=np.full(6, 10.0)), tmp_path / "wrong.csv")
    (found,) = json.loads(run(tmp_path / "wrong.csv", "--json", "-"))
    assert found["label"] == "R20C10"
    assert found["match"]["label_matches"] is False
    assert found["settings"][0] == "R20C50"


def test_what_is_missing_is_said(tmp_path):
    path = tmp_path / "plain.csv"
    write(recorded("R20C50", flow=False), path)
    message = run(path, code=2)
    assert message.startswith(f"{path}: there is neither a column flow (mL/s) nor volume (mL)")
    breaths = recorded("R20C50")
    assert breaths.flow is not None
    sparse = np.where(np.arange(90) % 9 == 0, breaths.flow, np.nan)
    write(replace(breaths, flow=sparse), tmp_path / "sparse.csv")
    message = run(tmp_path / "sparse.csv", code=2)
    assert message.startswith(f"{tmp_path / 'sparse.csv'}: R20C50: no piece of a breath")
    assert "there is no such file" in run(tmp_path / "none.csv", code=2)
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(b"PAR1 and nothing more")
    assert "broken.parquet" in run(broken, code=2)


def test_runs_of_which_none_has_flow_or_volume(public_recordings, tmp_path):
    whole = pandas.read_parquet(public_recordings / "respiraworks_quicklung.parquet")
    mute = whole[(whole["run"] == "2020-07-01-Control-Tests-AIR") & (whole["test"] == 1)]
    mute.to_parquet(tmp_path / "mute.parquet")
    assert "no run has flow or volume" in run(tmp_path / "mute.parquet", code=2)


def test_the_files_of_a_session_share_their_faults(tmp_path):
    """Two whose flow is no lung's say that it may be wrong on the third as well."""
    for name, share, late in (("a", 1.0, 9), ("b", 1.0, 9), ("c", 0.4, 0)):
        breaths = recorded("R20C50")
        assert breaths.flow is not None
        flow = share * np.roll(breaths.flow, late, axis=1)
        write(replace(breaths, flow=flow), tmp_path / f"{name}.csv")
    text = run(tmp_path, "--json", tmp_path / "lungs.json")
    assert "c: R20C50: 2 of the 3 lungs of its session show flow or volume" in text
    *_, weak = json.loads((tmp_path / "lungs.json").read_text())
    assert (weak["settings"], weak["match"]["informative"]) == ([], False)
