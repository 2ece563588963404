"""What holds for every command: how it ends; and the command that looks at the machine."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from hardware_eval import cli as hardware
from ventbench import __main__ as start
from ventbench import cli
from ventbench.base.errors import InputError
from ventbench.sandbox.runner import SandboxRunner

STOPPED = """
import sys
from hardware_eval import cli as hardware
from ventbench import cli

@cli.app.command()
def work(folder: str) -> None:
    if folder != "none":
        from pathlib import Path
        from ventbench.base.resume import WorkFolder
        WorkFolder(Path(folder), {"seed": 0})
    raise KeyboardInterrupt

cli.main()
"""

DROPPED = """
import signal, sys, time
from hardware_eval import cli as hardware
from ventbench import cli

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a shell runs this behind

class Drops:
    def __del__(self):
        raise KeyboardInterrupt

@cli.app.command()
def work() -> None:
    Drops()
    time.sleep(600)

cli.main()
"""


def _run(script, *arguments):
    command = [sys.executable, "-c", script, "work", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


def test_ctrl_c_says_that_the_same_command_continues(tmp_path):
    ended = _run(STOPPED, str(tmp_path / "parts"))
    assert ended.returncode == 130
    assert f"stopped; what is finished is kept in {tmp_path / 'parts'}" in ended.stderr
    assert "the same command continues" in ended.stderr


def test_ctrl_c_of_what_keeps_nothing_promises_nothing():
    ended = _run(STOPPED, "none")
    assert ended.returncode == 130
    assert ended.stderr.strip() == "ventbench: stopped"


def test_ctrl_c_that_a_callback_drops_still_stops():
    ended = _run(DROPPED)
    assert ended.returncode == 130
    assert "Exception ignored" not in ended.stderr


@pytest.mark.parametrize("package", ["ventbench", "hardware_eval"])
def test_ctrl_c_while_packages_are_imported(tmp_path, package):
    slow = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)\n"
    (tmp_path / "typer.py").write_text(slow)
    path = os.pathsep.join([str(tmp_path), str(Path(cli.__file__).parents[2])])
    script = "import runpy, signal\n"  # the signal is ignored where a shell runs this behind
    script += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    script += f"runpy.run_module({package!r}, run_name='__main__')\n"
    environment = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, "-c", script]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    program = {"hardware_eval": "ventbench-hardware"}.get(package, package)
    assert (ended.returncode, ended.stderr) == (130, f"{program}: stopped\n")


def test_python_m_ventbench():
    command = [sys.executable, "-m", "ventbench", "--version"]
    assert subprocess.run(command, capture_output=True, text=True).stdout.startswith("ventbench ")


def test_doctor_says_what_this_machine_can_do(monkeypatch, tmp_path):
    monkeypatch.setenv("VENTBENCH_RECORDINGS", str(tmp_path))
    ended = CliRunner().invoke(cli.app, ["doctor", "--json", "-"])
    report = json.loads(ended.stdout)
    assert f"0 files in {tmp_path}" == report["facts"]["recordings"]
    assert report["facts"]["simulators"].endswith("as published")
    missing = SandboxRunner().missing
    assert report["facts"]["official scores"].startswith("no" if missing else "yes")
    assert ended.exit_code == (1 if report["problems"] else 0)


def test_doctor_names_what_is_missing(monkeypatch):
    monkeypatch.setattr(SandboxRunner, "missing", property(lambda _: ("seccomp",)))
    ended = CliRunner().invoke(cli.app, ["doctor"])
    assert ended.exit_code == 1
    assert "not official: the sandbox lacks seccomp" in " ".join(ended.stdout.split())


@pytest.mark.parametrize(
    ("program", "words", "wanted"),
    [
        ("ventbench", "score pid_r", "pid_robust"),
        ("ventbench", "train pid --lung R5C1", "R5C10"),
        ("ventbench", "train pid --lung R20C1", "R20C10"),
        ("ventbench", "data open-loop --simulator two", "two_balloon"),
        ("ventbench-hardware", "run ppo", "ppo"),
        ("ventbench-hardware", "compare --simulator phy", "physics"),
    ],
)
def test_names_are_completed(program, words, wanted):
    apps = {"ventbench": cli.app, "ventbench-hardware": hardware.app}
    variables = {
        f"_{program.replace('-', '_').upper()}_COMPLETE": "complete_bash",
        "COMP_WORDS": f"{program} {words}",
        "COMP_CWORD": str(len(words.split())),
    }
    ended = CliRunner().invoke(apps[program], prog_name=program, env=variables)
    assert wanted in ended.stdout.split()


@pytest.mark.parametrize("former", cli.FORMER)
def test_a_former_name_says_the_new_one(former):
    words = ["data", "check", f"{former}=1"] if former.startswith("--") else former.split()
    ended = CliRunner().invoke(cli.app, [*words, "anything"])
    assert isinstance(ended.exception, InputError)
    now = cli.FORMER[former]
    assert f"`{former}` is now {now}" == str(ended.exception)
    for command in re.findall("`ventbench ([^`]*)`", now):
        words = [word for word in command.split() if re.fullmatch("[a-z]+(-[a-z]+)*", word)]
        assert CliRunner().invoke(cli.app, [*words, "--help"]).exit_code == 0


@pytest.mark.parametrize(
    ("app", "former"), [(cli.app, cli.FORMER), (hardware.app, hardware.FORMER)]
)
def test_no_option_has_a_former_name(app, former):
    groups: list[Any] = [typer.main.get_command(app)]
    for group in groups:
        groups += getattr(group, "commands", {}).values()
    options = {name for command in groups for option in command.params for name in option.opts}
    assert len(options) > 20
    assert not options & former.keys()
    news = {name.strip("`") for name in former.values() if name.startswith("`--")}
    assert news <= options


def test_about_twelve_commands_stand_at_the_top():
    top: Any = typer.main.get_command(cli.app)
    assert len(top.commands) <= 13


def test_completion_is_offered():
    text = CliRunner().invoke(cli.app, ["--help"], terminal_width=200).stdout
    assert "--install-completion" in text
    assert "--show-completion" in text


def test_without_the_extra_a_report_is_refused_before_anything_is_scored(monkeypatch, tmp_path):
    from ventbench.entries import scoring

    monkeypatch.setattr(scoring, "score", lambda *_, **__: pytest.fail("scored first"))
    for missing in ("jinja2", "rerun"):
        monkeypatch.setitem(sys.modules, missing, None)
        wanted = ["score", "pid_best", "--out", str(tmp_path), "--report"]
        ended = CliRunner().invoke(cli.app, wanted)
        assert isinstance(ended.exception, InputError)
        assert f"need {missing}: install ventbench[view]" in str(ended.exception)
        monkeypatch.delitem(sys.modules, missing)


def test_quiet_stands_before_or_behind_a_command():
    for given in (["--quiet", "score", "a"], ["score", "--quiet", "a"], ["score", "a", "--quiet"]):
        assert cli.options.quiet_first(given) == ["--quiet", "score", "a"]
    assert cli.options.quiet_first(["score", "a"]) == ["score", "a"]
    assert cli.options.quiet_first(["score", "--", "--quiet"]) == ["score", "--", "--quiet"]


def test_quiet_says_nothing_but_the_result(tmp_path):
    """Without it a reading command shows what it does on stderr; results stay either way."""
    script = "import sys; from ventbench import cli; from ventbench.cli import options\n"
    script += "@cli.app.command()\ndef work():\n"
    script += "    options.notes().print('note')\n    print('result')\n"
    script += "    with options.bar('steps') as steps:\n        steps(1, 2)\n"
    script += "sys.argv = ['ventbench', 'work', *sys.argv[2:]]\ncli.main()\n"
    loud, quiet = _run(script), _run(script, "--quiet")
    assert "note" in loud.stderr
    assert quiet.stderr == ""
    assert quiet.stdout == loud.stdout == "result\n"
    assert quiet.returncode == 0


def test_a_commands_linear_algebra_has_one_thread_unless_told_otherwise(monkeypatch):
    seen: list[str] = []
    name = "OPENBLAS_NUM_THREADS"
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setitem(
        sys.modules, "told", SimpleNamespace(main=lambda: seen.append(os.environ[name]))
    )
    monkeypatch.setenv(name, "3")
    start.main(module="told")
    monkeypatch.delenv(name)
    start.main(module="told")
    assert seen == ["3", "1"]
