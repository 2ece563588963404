"""``list lungs``, ``simulate`` and ``train simulator``, and the exit codes of the program."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import ventbench
from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.cli import app, options
from ventbench.plants import frozen
from ventbench.plants.stacking import take
from ventbench.simulation import Controls, read_controls, simulate
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.rollouts import open_loop
from ventbench.train.rigs import train as rigs

#: Records of the published leaderboard.
RECORDS = Path(__file__).resolve().parents[1] / "leaderboard" / "records"


def run(*arguments: object, code: int = 0) -> str:
    found = CliRunner().invoke(app, [*map(str, arguments)])
    if isinstance(found.exception, InputError | OSError):  # main() prints it and exits with 2
        assert code == 2
        return str(found.exception)
    assert found.exit_code == code, found.output
    return found.stdout


def program(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The real program, in its own process."""
    root = Path(ventbench.__file__).resolve().parents[1]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-c", "from ventbench.cli import main; main()", *map(str, arguments)],
        env=environment | {"PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def commands(tmp_path):
    """A breath: 10 % for a second, then the expiratory valve opens."""
    path = tmp_path / "commands.csv"
    rows = [f"{10 if i < 30 else 5},{int(i >= 30)},{0.033 * i:.3f}" for i in range(60)]
    path.write_text("\n".join(["u_in,u_out,time_step", *rows]) + "\n")
    return path


def columns(text: str) -> dict[str, np.ndarray]:
    rows = list(csv.DictReader(io.StringIO(text)))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_lungs_lists_the_six_with_their_errors():
    text = run("list", "lungs")
    for name, about in frozen.load().lungs().items():
        (line,) = [line for line in text.splitlines() if line.startswith(f"│ {name} ")]
        for kind in ("own_rig", "unseen_rig", "held_out"):
            assert f"{about[f'{kind}_mae']:.2f} / {about[f'{kind}_median_mae']:.2f}" in line


def test_many_breaths_are_each_simulated_alone(tmp_path):
    """Of two lungs and unequal lengths; what is written is a recording, and answers for another."""
    rng = np.random.default_rng(0)
    rows, path, out = (
        ["breath_id,R,C,time_step,u_in,u_out"],
        tmp_path / "many.csv",
        tmp_path / "o.csv",
    )
    lengths = {3: (5, 20, 40), 4: (20, 50, 30), 9: (5, 20, 40)}
    commands = {}
    for number, (R, C, length) in lengths.items():
        commands[number] = np.round(rng.uniform(0.0, 30.0, length), 3)
        rows += [
            f"{number},{R},{C},{0.03 * k:.2f},{u},{int(k >= 30)}"
            for k, u in enumerate(commands[number])
        ]
    path.write_text("\n".join(rows) + "\n")
    run("simulate", "--controls", path, "--simulator", "physics", "--out", out)
    breaths = ventbench.load_recording(out, pad=True)
    assert breaths.breath_id.tolist() == list(lengths)
    for index, (number, (R, C, length)) in enumerate(lengths.items()):
        u_out = (np.arange(length) >= 30).astype(float)
        alone = Controls(np.linspace(0.0, 0.03 * (length - 1), length), commands[number], u_out)
        wanted = simulate(alone, lung=f"R{R}C{C}", simulator="physics").pressure
        np.testing.assert_allclose(breaths.pressure[index, :length], wanted, atol=2e-3)
    printed = run("simulate", "--controls", path, "--simulator", "physics")
    assert printed.splitlines()[0] == out.read_text().splitlines()[0]
    recording = ventbench.load_recording(out, pad=True)
    with pytest.raises(InputError, match="is the recording itself; it has no column simulated"):
        ventbench.open_loop(recording, str(out))
    answers = tmp_path / "answers.csv"
    answers.write_text(out.read_text().replace(",pressure", ",simulated", 1))
    assert ventbench.open_loop(recording, str(answers)).lungs["R5C20"]["mae"] == 0.0
    (tmp_path / "bare.csv").write_text("breath_id,u_in\n1,5\n1,6\n2,7\n2,8\n")
    assert "name the lung" in run("simulate", "--controls", tmp_path / "bare.csv", code=2)
    text = run("simulate", "--controls", tmp_path / "bare.csv", "--lung", "R20C50")
    assert columns(text)["R"].tolist() == [20.0] * 4
    (tmp_path / "one.csv").write_text("u_in\n5\n6\n")
    assert "--lung is needed" in run("simulate", "--controls", tmp_path / "one.csv", code=2)


def test_the_shell_completes_entries_lungs_and_plants():
    assert options.complete_lungs("r20") == ["R20C10", "R20C20", "R20C50"]
    assert {"pid_best", "pid_robust"} <= set(options.complete_entries("pid"))
    assert "physics" in options.complete_plants("ph")
    for command, words, wanted in (
        ("ventbench", "ventbench simulate --lung R5", "R5C10"),
        ("ventbench", "ventbench score pid_r", "pid_robust"),
        ("ventbench-hardware", "ventbench-hardware selftest --lung R5", "R5C10"),
    ):
        module = {"ventbench": "ventbench.cli", "ventbench-hardware": "hardware_eval.cli"}[command]
        code = f"import sys; sys.argv = ['{command}']; from {module} import main; main()"
        variable = f"_{command.upper().replace('-', '_')}_COMPLETE"
        environment = {**os.environ, variable: "complete_bash", "COMP_WORDS": words}
        environment["COMP_CWORD"] = str(len(words.split()) - 1)
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True
        )
        assert wanted in done.stdout.split(), done.stderr


def test_lungs_tells_which_sessions_are_not_scored():
    text = " ".join(run("list", "lungs").split())
    official = frozen.load()
    six = [i for i in official.rejected if official.sessions.table[i].lung in official.lung_ids]
    assert six
    for session in six:
        assert f"not scored: session {session} of" in text


def test_lungs_as_json():
    assert json.loads(run("list", "lungs", "--json", "-")) == frozen.load().lungs()


@pytest.mark.parametrize("name", ["R5C10", "R20C50"])
def test_simulate_answers_commands_with_the_official_pressures(commands, tmp_path, name):
    text = run("simulate", "--lung", name, "--controls", commands, "--start", "6")
    found = columns(text)
    assert list(found) == ["time_step", "u_in", "u_out", "pressure"]
    np.testing.assert_allclose(found["time_step"], 0.033 * np.arange(60), atol=1e-6)
    (given,), plant = read_controls(commands), take(frozen.load().plants, LUNG_IDS.index(name))
    with compilation.float64():
        row = [jnp.asarray(x)[None] for x in (given.u_in, given.u_out, given.dt)]
        wanted = open_loop(plant, jnp.asarray([6.0]), *row)[0]
    np.testing.assert_allclose(found["pressure"], wanted, atol=1e-6)
    np.testing.assert_array_equal(simulate(given, lung=name, start=6.0).pressure, wanted)
    assert found["pressure"][0] == 6.0
    assert found["pressure"][29] > 8.0 > found["pressure"][-1]
    out = tmp_path / "out.csv"
    assert run("simulate", "--lung", name, "--controls", commands, "--start", 6, "--out", out) == ""
    assert out.read_text() == text


def test_simulate_without_times_takes_the_protocols(tmp_path):
    path = tmp_path / "commands.csv"
    path.write_text("u_in\n" + "8\n" * 5)
    found = columns(run("simulate", "--lung", "R5C20", "--controls", path))
    np.testing.assert_allclose(found["time_step"], protocol.DT * np.arange(5))
    assert found["pressure"][0] == protocol.PEEP
    assert not found["u_out"].any()


def test_simulate_refuses_bad_input(commands, tmp_path):
    message = run("simulate", "--lung", "R9", "--controls", commands, code=2)
    assert "'R9' is not a lung id" in message
    message = run("simulate", "--lung", "R5C30", "--controls", commands, code=2)
    assert f"the simulators frozen have {', '.join(LUNG_IDS)}" in message
    bad = tmp_path / "bad.csv"
    bad.write_text("u_in\n5\n120\n")
    message = run("simulate", "--lung", "R5C10", "--controls", bad, code=2)
    assert "line 3, column u_in: '120' is outside" in message


def test_train_needs_recordings(tmp_path, monkeypatch):
    message = run("train", "simulator", "--recordings", tmp_path / "nowhere", code=2)
    assert "nowhere is no folder; give --recordings DIR" in message
    monkeypatch.setenv("VENTBENCH_RECORDINGS", str(tmp_path / "gone"))
    assert "no folder of the public recordings; give" in run("train", "simulator", code=2)
    to_train = ("train", "simulator", "--recordings", tmp_path, "--out", tmp_path / "x")
    assert "holds no recording in the public schema" in run(*to_train, code=2)
    assert not (tmp_path / "x").exists()


def test_train_hands_over_folder_target_and_progress(tmp_path, monkeypatch):
    called = []

    def train(folder, out, *, lungs=None, config=None, progress):
        progress("half", 0.5)
        called.append((folder, out, lungs))

    monkeypatch.setattr(rigs, "train_rigs", train)
    out = tmp_path / "out"
    command = ("train", "simulator", "--recordings", tmp_path, "--out", out)
    assert f"wrote {out}" in run(*command, "--lungs", "R5C10,R9C33")
    run(*command)
    assert called == [(tmp_path, out, ["R5C10", "R9C33"]), (tmp_path, out, None)]


def test_the_program_ends_with_2_and_one_line(tmp_path):
    for arguments, message in (
        (("data", "open-loop", tmp_path / "none.csv"), "no such file"),
        (
            ("train", "simulator", "--recordings", tmp_path / "nowhere", "--out", tmp_path / "out"),
            "is no folder; give --recordings DIR",
        ),
    ):
        found = program(*arguments)
        assert found.returncode == 2
        assert found.stdout == ""
        assert found.stderr.startswith("ventbench: ")
        assert message in found.stderr
        assert len(found.stderr.splitlines()) == 1
