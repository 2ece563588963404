"""The command line on a virtual port, and the manual's commands."""

from __future__ import annotations

import json
import os
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main
from mcap.reader import make_reader
from msgspec.structs import asdict
from typer.testing import CliRunner

from hardware_eval import cli
from hardware_eval.bench.controllers import ControllerFailedError, SubmissionController
from hardware_eval.bench.plan import read_procedure
from hardware_eval.bench.raw_log import breaths, lines
from hardware_eval.commands import show
from hardware_eval.device.program import Identity
from hardware_eval.emulation.emulator import LoopbackDevice
from hardware_eval.results import evaluate
from hardware_eval.results.evaluate import Line
from hardware_eval.wire.client import Client
from hardware_eval.wire.messages import Capability
from tests.hardware_eval.stand_in import Bench
from ventbench.base.errors import InputError
from ventbench.board import record
from ventbench.board.record import HardwareRecord

MANUAL = Path(cli.__file__).parent / "README.md"


@pytest.fixture
def on_line(line: Line, monkeypatch: pytest.MonkeyPatch) -> Line:
    monkeypatch.setattr(evaluate, "connect", lambda port, confirmed=True: line)
    return line


def invoke(*words: str) -> Any:
    return CliRunner().invoke(cli.app, list(words))


def scored(out: Path, plan: Path) -> tuple[Any, Path]:
    """One scored run of an entry, in this process; what `run` said, and its JSON."""
    result = out.with_suffix(".json")
    line = "run pid_best --port p --lung R5C20 --pips 10 --repeats 1 --in-process --yes"
    line += f" --plan {plan} --out {out} --json {result}"
    return invoke(*shlex.split(line)), result


def test_run_makes_a_record_and_replay_agrees(
    on_line: Line, tmp_path: Path, scored_only: Path
) -> None:
    with scored_only.open("a") as plan:
        plan.write("blind = true\n")
    out = tmp_path / "out"
    done, result = scored(out, scored_only)
    assert done.exit_code == 0, done.output
    # Who stands at the bench learns at the end which entry it was.
    blinded, _, revealed = done.output.partition("entry 1 is pid_best")
    assert "entry 1" in blinded
    assert "pid_best" not in blinded
    assert "pid_best: record" in revealed
    told = json.loads(result.read_text())
    made = record.load(Path(told["records"]["pid_best"]))
    assert isinstance(made, HardwareRecord)
    assert Path(told["recording"]).is_file()
    assert made.header.selftest == {"R5C20": ["leak", "lung", "sensor", "sweep"]}
    assert made.header.safety["fallback"]["hand_back"] == 3
    assert made.header.timing["fallback_share"] == 0.0
    file = tmp_path / "session.mcap"
    again = invoke("replay", str(out), "--record", told["records"]["pid_best"], "--mcap", str(file))
    with open(file, "rb") as opened:  # read by the package's own reader
        messages = [json.loads(x.data) for _, _, x in make_reader(opened).iter_messages()]
    logged = [breath.log for breath in breaths(lines(out / "raw.jsonl")) if breath.log.time]
    assert len(messages) == sum(len(breath.time) for breath in logged)
    assert messages[5]["pressure"] == logged[0].pressure[5]
    assert again.exit_code == 0, again.output
    assert "2 of 2 runs are done" in again.output
    unwritten = invoke("replay", str(out), "--rerun", str(file / "session.rrd"))
    assert isinstance(unwritten.exception, InputError)
    assert str(unwritten.exception).startswith(f"--rerun {file}")
    # The drawn seed is the plan's, so that the same command finds it done.
    assert evaluate.begun_plan(out) is not None
    analysed = invoke("trial", str(out))
    assert analysed.exit_code == 0, analysed.output
    assert f"pid_best: error {made.score:.4g}" in analysed.output
    assert "no whole dry run" in analysed.output


def test_without_a_terminal_and_without_yes_nothing_moves(
    on_line: Line, tmp_path: Path, scored_only: Path
) -> None:
    words = f"run pid_best --port p --lung R5C20 --in-process --plan {scored_only}".split()
    done = invoke(*words, "--out", str(tmp_path / "out"))
    assert done.exit_code == 1
    assert "did not confirm" in done.output


def raises(self: Any, row: Any, budget: float) -> float:
    raise ControllerFailedError("it raised ValueError")


@pytest.mark.parametrize(
    ("act", "said"),
    [(raises, "it raised ValueError"), (lambda *_: None, "102 of 102 answers took longer")],
    ids=["raises", "late"],
)
def test_an_entry_of_which_every_run_failed_has_no_score(
    act: Any,
    said: str,
    on_line: Line,
    tmp_path: Path,
    scored_only: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(SubmissionController, "act", act)
    done, result = scored(tmp_path / "out", scored_only)
    assert done.exit_code == 1, done.output
    assert "no score: 1 of 1 runs failed" in done.output
    assert said in done.output
    assert "board add" not in done.output
    assert json.loads(result.read_text())["complete"] is False


def test_the_port_and_not_the_device_decides_what_is_emulated(tmp_path: Path) -> None:
    master, slave = os.openpty()
    link = tmp_path / "ttyACM0"  # called what it likes
    link.symlink_to(os.ttyname(slave))
    kinds = {
        "virtual:R5C20": "virtual",
        str(link): "pseudo-terminal",
        "/dev/ttyACM0": "serial",
        "socket://localhost:5": "own socket",
        "socket://127.0.1.1:5": "own socket",
        "socket://pi.lan:5005": "socket",
        "/dev/ttys003": "pseudo-terminal",
    }
    assert {port: evaluate.port_kind(port) for port in kinds} == kinds
    for descriptor in (master, slave):
        os.close(descriptor)
    hardware = Identity("bench", b"12345678", bytes(32), Capability.NONE)
    device = LoopbackDevice(Bench(identity=hardware))
    client = Client(device, device.clock)
    for kind, emulated in (("serial", False), ("pseudo-terminal", True), ("virtual", True)):
        about = evaluate.device_about(Line(client, device.clock, port=kind))
        assert about["emulated"] is emulated
        assert about["about"]["says_simulated"] is False


def test_a_command_waits_for_an_emulator_that_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    port, waits = tmp_path / "lung", []

    def sleep(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 3:
            port.touch()

    monkeypatch.setattr(evaluate.time, "sleep", sleep)
    monkeypatch.setattr(evaluate, "Link", lambda url: url)
    assert evaluate.carrier(str(port))[0] == str(port)
    assert "is an emulator starting" in capsys.readouterr().err
    assert len(waits) == 3
    evaluate.carrier("/dev/ttyACM7")  # a cable that is out is told at once
    assert len(waits) == 3


def commands() -> list[str]:
    text = "\n".join(re.findall(r"^```sh\n(.*?)^```", MANUAL.read_text("utf-8"), re.M | re.S))
    lines = [part.strip(" &") for line in text.splitlines() for part in line.split("&&")]
    return [line for line in lines if line.startswith("ventbench-hardware ")]


@pytest.mark.parametrize("line", commands())
def test_the_manuals_commands_parse(line: str) -> None:
    words = shlex.split(line)[1:]
    group: Any = typer.main.get_command(cli.app)
    command = group.commands[words[0]]
    context = command.context_class(command, info_name=words[0])
    command.make_parser(context).parse_args(args=words[1:])


def test_wrong_numbers_and_ports_are_bad_input(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["ventbench-hardware", "run", "pid_best", "--lung", "R5C20", "--port", "/dev/nothing"]
    for extra, said in ((["--pips", "ten"], "--pips 'ten'"), ([], "/dev/nothing")):
        monkeypatch.setattr("sys.argv", [*words, *extra])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == 2
        assert said in capsys.readouterr().err


def test_a_calibrated_part_is_written_as_json(on_line: Line, tmp_path: Path) -> None:
    out, result = tmp_path / "calibration.json", tmp_path / "result.json"
    line = f"calibrate peep --port p --lung R5C20 --yes --out {out} --json {result}"
    done = invoke(*shlex.split(line))
    assert done.exit_code == 0, done.output
    told = json.loads(result.read_text())
    assert told["fit"]["intercept"]["value"] == pytest.approx(5.0, abs=0.1)
    assert told["fit"]["slope"]["value"] is None
    assert told["file"] == str(out)


def test_numbers_of_numpy_and_paths_become_json(tmp_path: Path) -> None:
    path = tmp_path / "shown.json"
    show({"a": np.float64(1.5), "b": [np.nan, np.int64(2)], "c": path}, path, "shown")
    assert json.loads(path.read_text()) == {"a": 1.5, "b": [None, 2], "c": str(path)}


def test_the_manual_lists_every_key_of_a_plan(tmp_path: Path) -> None:
    (block,) = re.findall(r"^```toml\n(.*?)^```", MANUAL.read_text("utf-8"), re.M | re.S)
    path = tmp_path / "plan.toml"
    path.write_text(block)
    given, usual = asdict(read_procedure(path)), asdict(read_procedure(None))
    assert set(tomllib.loads(block)) == set(usual)
    shown = {name: value for name, value in given.items() if usual[name] not in (None, "", ())}
    assert shown == {name: usual[name] for name in shown}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("repeats = 0", "Expected `int` >= 1 - at `$.repeats`"),
        ("repaets = 3", "unknown field `repaets`"),
        ("pips = 10", "Expected `array`, got `int` - at `$.pips`"),
        ("rest = nan", "$.rest"),
        ("largest_u_in = 0", "Expected `float` > 0.0 - at `$.largest_u_in`"),
        ("largest_rise = 101.0", "Expected `float` <= 100.0 - at `$.largest_rise`"),
        ("repeats == 3", "line 1, column"),
    ],
)
def test_a_wrong_plan_is_refused_with_its_key(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(said)) as refused:
        read_procedure(path)
    assert str(path) in str(refused.value)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("run pid_best --lung R5C20 --out {file}", "is a file, not a folder"),
        ("calibrate zero --out {file}/calibration.json", "is a file, not a folder"),
        ("selftest --lung R5C20 --simulator nothing", "--simulator 'nothing'"),
        ("selftest --lung R5C20 --skip nothing", "no part 'nothing'"),
        ("collect --lung R5C20 --out {file}", "is a file, not a folder"),
        ("bringup --operator ''", "--operator: give the name"),
    ],
)
def test_what_would_be_lost_at_the_end_is_refused_before_the_port_is_opened(
    line: str, said: str, tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.touch()
    words = shlex.split(line.format(file=file, new=tmp_path / "new"))
    done = invoke(*words, "--port", "/dev/nothing")
    assert isinstance(done.exception, InputError)
    assert said in str(done.exception)
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    "port", ["socket://localhost", "socket://localhost:ten", "foo://bar", "loop://"]
)
def test_a_port_that_is_none_is_told_what_one_is(port: str) -> None:
    done = invoke("conformance", "--port", port)
    assert isinstance(done.exception, InputError)
    assert re.fullmatch(f"port '{port}': .* .*; write a device such as .*", str(done.exception))


@pytest.mark.parametrize("line", ["replay", "compare", "trial", "report"])
def test_a_folder_without_a_session_is_named(line: str, tmp_path: Path) -> None:
    done = invoke(line, str(tmp_path))
    assert isinstance(done.exception, InputError)
    assert str(done.exception) == f"{tmp_path}/raw.jsonl is not there: give the folder of a session"


def test_a_demo_without_words_leaves_nothing(tmp_path: Path) -> None:
    done = invoke("demo", "--conceal", "", "--out", str(tmp_path / "out"))
    assert "give some words" in str(done.exception)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--lung R7", "R7"),
        ("--simulator nothing", "nothing"),
        ("--link {file}", "{file}: there is a file of that name"),
        ("--link {file}/lung", "is no folder; make it first"),
        ("--firmware {new}", "make it with `make`"),
    ],
)
def test_a_lung_that_cannot_be_emulated_is_refused_before_it_is_compiled(
    line: str, said: str, tmp_path: Path
) -> None:
    file, new = tmp_path / "file", tmp_path / "new"
    file.touch()
    done = invoke("emulate", *shlex.split(line.format(file=file, new=new)))
    assert isinstance(done.exception, InputError)
    assert said.format(file=file) in str(done.exception)
    assert "compiling" not in done.output
    assert list(tmp_path.iterdir()) == [file]
