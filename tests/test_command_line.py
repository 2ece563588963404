"""What holds for every command: how it ends."""

import subprocess
import sys

STOPPED = """
import sys
from ventbench import cli

@cli.app.command()
def work(folder: str) -> None:
    if folder != "none":
        from pathlib import Path
        from ventbench.resume import WorkFolder
        WorkFolder(Path(folder), {"seed": 0})
    raise KeyboardInterrupt

cli.main()
"""

DROPPED = """
import sys, time
from ventbench import cli

class Drops:
    def __del__(self):
        raise KeyboardInterrupt

@cli.app.command()
def work() -> None:
    Drops()
    time.sleep(60)

cli.main()
"""


def _run(script, *arguments):
    command = [sys.executable, "-c", script, "work", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=50)


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


def test_python_m_ventbench():
    command = [sys.executable, "-m", "ventbench", "--version"]
    assert subprocess.run(command, capture_output=True, text=True).stdout.startswith("ventbench ")
