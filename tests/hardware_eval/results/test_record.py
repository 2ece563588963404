"""From a plan to a hardware record on the leaderboard, by the same code as at a bench."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from typer.testing import CliRunner

from hardware_eval import cli
from hardware_eval.bench.loop import Operator
from hardware_eval.bench.plan import Procedure, make_plan
from hardware_eval.results import evaluate as ev
from hardware_eval.results import record as records
from hardware_eval.results.evaluate import Line
from hardware_eval.results.record import recorded_breaths, replay
from hardware_eval.results.trial import analyse
from ventbench.base.errors import InputError
from ventbench.board import build, canonical, frames, gate, record, store
from ventbench.board.record import HardwareRecord
from ventbench.board.replay import load as replay_of_board
from ventbench.entries.folder import open_submission
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS

#: Page of the board.
BOARD = "index.html"

LUNG, PIPS = "R5C20", (10.0, 15.0)

HOW = Procedure(fallback=False, dry_run=False, selftest=False, rest=1.0)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, shared_device: Any) -> ev.Evaluation:
    """The paper's PID on the emulated lung: two PIPs, two repetitions."""
    from hardware_eval.wire.client import Client

    client = Client(shared_device, shared_device.clock)
    client.hello()
    plan = make_plan(["pid_best"], [LUNG], pips=PIPS, repeats=2, control_every=3)
    return ev.evaluate(
        [open_submission("pid_best")],
        Line(client, shared_device.clock),
        tmp_path_factory.mktemp("bench"),
        Operator(),
        plan=plan,
        sandbox=False,
        how=structs.replace(HOW, notes="a note"),
        operator_name="A. Person",
    )


@pytest.fixture(scope="module")
def path(done: ev.Evaluation) -> Path:
    assert not done.reason
    return done.records["pid_best"]


def loaded(path: Path) -> HardwareRecord:
    made = record.load(path)
    assert isinstance(made, HardwareRecord)
    return made


def test_the_record_holds_score_device_and_recording(done: ev.Evaluation, path: Path) -> None:
    made = loaded(path)
    header = made.header
    assert header.device.emulated
    assert header.track == "hardware"
    assert header.simulated_track == "performance"
    assert (header.operator, header.notes) == ("A. Person", "a note")
    assert header.recording.sha256 == canonical.digest(done.log.read_bytes())
    assert made.errors.shape == (1, 2, 2)
    assert np.isfinite(made.errors).all()
    assert len(header.control[LUNG]["errors"]) == 3  # before the first, the fourth, at the end
    assert header.timing["lost"] == 0
    assert (header.timing["outside"], header.timing["fallback_share"]) == (0, 0.0)
    assert header.safety["fallback"] is None
    assert header.selftest == {LUNG: ["leak", "lung", "sensor", "sweep"]}
    assert set(header.safety) >= {"over_pressure", "stuck_sensor", "largest_u_in"}
    assert header.safety["over_pressure"]["reason"]


def test_the_log_gives_the_errors_of_the_record(done: ev.Evaluation, path: Path) -> None:
    assert replay(done.log, record=path).problems == ()
    assert analyse([done.log]).entries["pid_best"].score.value == pytest.approx(
        loaded(path).score, abs=1e-3
    )


def changed(path: Path, change: Any) -> bytes:
    values = json.loads(path.read_bytes())
    change(values)
    return canonical.canonical(values)


def lower(values: dict[str, Any]) -> None:
    values["errors"][0][0][0] -= 0.01


def without_stop(values: dict[str, Any]) -> None:
    values["errors"][0][0][0] = None
    for table in values["trace"].values():
        table[0][0][0] = None


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lower, "errors"),
        (without_stop, "stops"),
        (lambda v: v["lungs"].append("R5C10"), "errors"),
        (lambda v: v.update(pips=[10.0, 12.0]), "pips"),
        (lambda v: v.update(unknown=1), "unknown"),
        (lambda v: v["safe"].append(True), "safe"),
        (lambda v: v["submission"]["files"].clear(), "submission"),
    ],
)
def test_a_record_that_contradicts_itself_is_refused(path: Path, change: Any, key: str) -> None:
    with pytest.raises(InputError, match=key):
        record.from_bytes(changed(path, change), "it")


def test_the_board_shows_it_beside_the_simulated_score(path: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "leaderboard", tmp_path / "site"
    shutil.copytree(Path(__file__).parents[3] / "leaderboard", folder)
    build.build(folder, out)
    (untouched,) = out.glob("entries/*/robustness/pid_robust.html")
    other = untouched.read_bytes()
    added = store.add(folder, path)
    assert isinstance(added, HardwareRecord)
    (hardware,) = frames.load_tracks(folder, track="performance")[0].hardware
    assert hardware.reasons == (
        "software stood in for the ventilator and its lung",
        gate.NO_BENCH_LOG,
        "no self-test of the sensor's zero on R5C20",
        "no self-test of which lung was mounted on R5C20",
    )
    assert hardware.rank is None
    done = build.build(folder, out)
    assert BOARD in done.changed
    page = (out / BOARD).read_text()
    made = loaded(path)
    simulated = next(
        entry
        for entry in reversed(replay_of_board(folder).scores)
        if entry.official and entry.key[1:] == ("performance", "pid_best")
    )
    lung, pips = LUNG_IDS.index(LUNG), [protocol.PIPS.index(pip) for pip in PIPS]
    gap = made.score - simulated.figures.nominal[lung, pips].mean()
    assert f"{made.score:.3f}" in page
    assert f">{gap:+.3f}<".replace("-", "−") in page.replace("-", "−")
    assert "emulator" in page
    assert untouched.read_bytes() == other
    with pytest.raises(InputError, match="already"):
        store.add(folder, path)
    taken = store.withdraw(folder, made.sha256, "a test")
    for signature in folder.rglob("*.sig"):
        signature.unlink()
    (folder / "attestations.toml").write_text(
        f'[[second_runs]]\nrecord = "{taken.sha256}"\nreason = "a test"\ndate = 2026-11-23\n'
    )
    build.build(folder, out)
    assert "withdrawn: a test" in (out / BOARD).read_text()


def test_the_recording_is_compared_with_simulators(path: Path) -> None:
    figures = []
    for plant in ("physics", "frozen"):
        words = ["compare", str(path), "--simulator", plant, "--no-diagnose", "--json", "-"]
        done = CliRunner().invoke(cli.app, words)
        assert done.exit_code == 0, done.output
        figures.append(json.loads(done.stdout)["lungs"][LUNG])
    own, frozen = figures
    # The emulated lung is the physics; its own simulator is nearer to it than the real rig's.
    assert own["mae"] < 0.35 < frozen["mae"]
    assert own["breaths"] == frozen["breaths"] == len(recorded_breaths(path))


def test_a_record_without_its_log_says_where_to_look(path: Path, tmp_path: Path) -> None:
    alone = tmp_path / path.name
    shutil.copy(path, alone)
    with pytest.raises(InputError, match="beside it"):
        recorded_breaths(alone)
    (tmp_path / "raw.jsonl").write_text('{"type":"log"}\n')
    with pytest.raises(InputError, match="by its hash"):
        recorded_breaths(alone)


def test_a_plan_that_is_not_finished_has_no_record(line: Line, tmp_path: Path) -> None:
    class Refuses(Operator):
        def confirm(self, question: str) -> bool:
            return "raise PIP" not in question

    plan = make_plan(["pid_best"], [LUNG], pips=PIPS, repeats=1)
    submission = open_submission("pid_best")
    made = ev.evaluate([submission], line, tmp_path, Refuses(), plan=plan, how=HOW, sandbox=False)
    assert made.reason
    assert not made.records
    with pytest.raises(InputError, match="are left"):
        records.hardware_record(made.log, submission)
