"""The open-loop test of a recording, as a function and as ``ventbench data open-loop``."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from proofs.studies.networks import MEASURED
from ventbench import simulation
from ventbench.base.compilation import float64
from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.plants import frozen
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants
from ventbench.recordings import Breaths, load, make_breaths, write
from ventbench.task.lungs import LUNG_IDS, lung
from ventbench.task.rollouts import open_loop

single_compartments = partial(nominal_plants, single_compartment)


FIGURES = ("mae", "median_mae", "ci95", "breaths")
PREFIXES = ("", "held_out_", "official_held_out_")
SAMPLES, INSPIRATORY = 40, 30


def as_json(*arguments):
    return simulation.open_loop(*arguments).as_dict()


def answered(plants_for, lungs: list[str], seed: int = 0, noise: float = 0.3) -> Breaths:
    """Breaths whose pressures are some plants' own, with errors of known mean."""
    rng = np.random.default_rng(seed)
    n = len(lungs)
    time = np.tile(0.034 * np.arange(SAMPLES), (n, 1))
    u_in = np.repeat(rng.uniform(3.0, 12.0, (n, SAMPLES // 5)), 5, axis=1)
    u_out = np.broadcast_to(np.arange(SAMPLES) >= INSPIRATORY, u_in.shape) * 1.0
    settings = [lung(name) for name in lungs]
    R, C = [x.R for x in settings], [x.C for x in settings]
    breaths = make_breaths(np.arange(n) + 1, R, C, time, u_in, u_out, np.full(u_in.shape, 5.0))
    with float64():
        columns = (breaths.pressure[:, 0], u_in, u_out, breaths.dt)
        pressure = np.array(open_loop(plants_for(breaths), *columns))  # type: ignore[arg-type]
    # The same error up and down: a breath's mean is `noise` exactly.
    error = noise * np.where(rng.uniform(size=pressure.shape) < 0.5, -1.0, 1.0)
    error[:, 0] = 0.0
    return replace(breaths, pressure=pressure + error)


@pytest.fixture(scope="module")
def simulators():
    return frozen.load()


@pytest.fixture(scope="module")
def breaths(simulators):
    """Three breaths of each of two lungs, answered by the official simulators."""
    return answered(simulators.for_breaths, ["R5C20"] * 3 + ["R20C50"] * 3)


def test_the_error_is_the_one_that_was_put_in(breaths):
    report = simulation.open_loop(breaths)
    result = report.as_dict()
    assert list(result["lungs"]) == ["R5C20", "R20C50"]
    for one in result["lungs"].values():
        for prefix in PREFIXES:  # new breaths: the official simulators judge them
            assert one[f"{prefix}mae"] == pytest.approx(0.3, abs=1e-9)
            assert one[f"{prefix}median_mae"] == pytest.approx(0.3, abs=1e-9)
            assert one[f"{prefix}breaths"] == 3
            low, high = one[f"{prefix}ci95"]
            assert low <= one[f"{prefix}mae"] + 1e-12
            assert high >= one[f"{prefix}mae"] - 1e-12
    assert result["not_judged"] == []
    assert report.remarks() == []
    assert json.loads(json.dumps(result, allow_nan=False)) == result


@pytest.mark.parametrize("kind", ["frozen", "hybrid", "physics"])
def test_each_kind_is_what_it_says(simulators, breaths, kind):
    kinds: dict[str, Any] = {"physics": single_compartments}
    error = simulation.open_loop_errors(kinds.get(kind, simulators.for_breaths), breaths)
    result = as_json(breaths, kind)
    assert result["plant"] == kind
    assert result["simulators"] == simulators.about()
    for name, index in breaths.by_lung_index.items():
        one = result["lungs"][name]
        assert one["mae"] == pytest.approx(error[index].mean(), abs=1e-6)
        assert one["held_out_breaths"] == 3
    # 0.3 is the noise; only the official simulators have no error of their own.
    assert (error.mean() > 0.35) == (kind in kinds)


def test_breaths_without_a_first_pressure_are_not_judged(breaths):
    pressure = breaths.pressure.copy()
    pressure[1, 0] = np.nan
    pressure[5, 1:INSPIRATORY] = np.nan
    report = simulation.open_loop(replace(breaths, pressure=pressure))
    result = report.as_dict()
    assert result["not_judged"] == [2, 6]
    assert [one["breaths"] for one in result["lungs"].values()] == [2, 2]
    assert "2 breaths have no first pressure" in report.remarks()[-1]


def test_progress_counts_every_simulated_breath(breaths):
    told = []
    simulation.open_loop(breaths, progress=lambda *counts: told.append(counts))
    assert told == [(6, 12), (12, 12)]


def run(*arguments: object, code: int = 0) -> str:
    found = CliRunner().invoke(app, [*map(str, arguments)])
    if isinstance(found.exception, InputError | OSError):  # main() prints it and exits with 2
        assert code == 2
        message = str(found.exception)
        assert "\n" not in message.strip()
        return message
    assert found.exit_code == code, found.output
    return found.output


def test_the_command_writes_what_the_function_finds(breaths, tmp_path):
    for name in ("lab.csv", "lab.parquet"):
        write(breaths, tmp_path / name)
        out = tmp_path / "out.json"
        text = run("data", "open-loop", tmp_path / name, "--json", out)
        result = json.loads(out.read_text())
        assert result == as_json(load(tmp_path / name))
        for lung_id in ("R5C20", "R20C50"):
            assert lung_id in text
            assert set(result["lungs"][lung_id]) == {
                prefix + figure for prefix in PREFIXES for figure in FIGURES
            }
            assert len(result["lungs"][lung_id]["ci95"]) == 2


@pytest.mark.parametrize("kind", ["frozen", "hybrid", "physics"])
def test_the_command_knows_all_kinds(breaths, tmp_path, kind):
    write(breaths, tmp_path / "lab.csv")
    text = run("data", "open-loop", tmp_path / "lab.csv", "--simulator", kind, "--json", "-")
    result = json.loads(text[text.index("{") : text.rindex("\n}") + 2])
    assert result["plant"] == kind
    assert f"of the {kind} simulators" in text


def test_bad_recordings_are_refused_in_one_line(breaths, tmp_path):
    text = tmp_path / "text.csv"
    text.write_text("a,b\n1,2\n")
    assert "missing columns" in run("data", "open-loop", text, code=2)
    assert "no such file" in run("data", "open-loop", tmp_path / "none.csv", code=2)
    write(replace(breaths, C=np.full(6, 30.0)), tmp_path / "lab.csv")
    message = run("data", "open-loop", tmp_path / "lab.csv", code=2)
    assert "lung R5C30, for which there is no simulator; known are R5C10" in message
    u_in = breaths.u_in.copy()
    u_in[2, 7] = 104.2
    write(replace(breaths, u_in=u_in), tmp_path / "lab.csv")
    message = run("data", "open-loop", tmp_path / "lab.csv", code=2)
    assert "line 89, column u_in: 104.2 is outside 0..100" in message
    assert "R5C20" in run("data", "open-loop", tmp_path / "lab.csv", "--clip")
    message = run(
        "data", "open-loop", tmp_path / "lab.csv", "--clip", "--simulator", "magic", code=2
    )
    assert "--simulator 'magic': there is no such file" in message


def test_the_public_recordings_give_the_held_out_errors_of_the_manifest(
    simulators, public_recordings, tmp_path
):
    out = tmp_path / "out.json"
    run("data", "open-loop", public_recordings / MEASURED, "--json", out)
    result = json.loads(out.read_text())
    assert len(result["lungs"]) == 9
    for name in LUNG_IDS:
        one, known = result["lungs"][name], simulators.lungs()[name]
        assert one["held_out_breaths"] == one["breaths"] == known["held_out_breaths"]
        # The simulators that score were trained on every public breath.
        assert one["official_held_out_breaths"] == 0
        for figure in ("held_out_mae", "held_out_median_mae", "held_out_ci95"):
            assert one[figure] == pytest.approx(known[figure], abs=2e-6)
        assert one["official_held_out_mae"] is None
        assert one["mae"] < one["held_out_mae"]


def test_errors_on_training_breaths_exported_again_are_not_printed_as_held_out(public_recordings):
    breaths = load(public_recordings / MEASURED)
    breaths = breaths.select(breaths.by_lung_index["R5C20"][:6])
    u_in, pressure = np.round(breaths.u_in, 2), np.round(breaths.pressure, 2)
    pressure[2, 7] = np.nan
    report = simulation.open_loop(replace(breaths, u_in=u_in, pressure=pressure))
    result = report.as_dict()
    assert result["lungs"]["R5C20"]["official_held_out_breaths"] == 0
    assert result["perhaps_copies"] == [int(breaths.breath_id[2])]
    assert "1 breath is perhaps a copy of one in the training" in report.remarks()[-1]
