"""Keys on a real pseudo-terminal: one before a question never confirms, and no stop is lost."""

from __future__ import annotations

import fcntl
import os
import random
import struct
import termios
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from hardware_eval.bench.console import ConsoleOperator
from hardware_eval.bench.loop import Bench, EmergencyStop
from hardware_eval.bench.plan import make_plan
from hardware_eval.bench.raw_log import RawLog
from hardware_eval.bench.session import run_plan

#: Keys that people press; each burst is one to four of them.
KEYS = "yYnN x\n\x1b"


class Keyboard:
    """The other end of a terminal."""

    def __init__(self) -> None:
        self._master, self.slave = os.openpty()

    def press(self, keys: str) -> None:
        """Press keys; returns when the terminal holds them all."""
        os.write(self._master, keys.encode())
        while self.waiting() < len(keys):
            time.sleep(1e-4)

    def press_later(self, keys: str, after: float) -> threading.Timer:
        timer = threading.Timer(after, os.write, (self._master, keys.encode()))
        timer.start()
        return timer

    def waiting(self) -> int:
        return struct.unpack("i", fcntl.ioctl(self.slave, termios.FIONREAD, b"\0" * 4))[0]

    def hang_up(self) -> None:
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, self.slave)
        os.close(nothing)

    def close(self) -> None:
        os.close(self._master)


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[Keyboard]:
    made = Keyboard()
    with os.fdopen(made.slave, "r") as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield made
    made.close()


def test_bursts_before_a_question_never_confirm_and_are_stops(keyboard: Keyboard) -> None:
    draw = random.Random(0)
    person = ConsoleOperator(reaction=0.0)
    with person.keys():
        for _ in range(500):
            keyboard.press("".join(draw.choices(KEYS, k=draw.randint(1, 4))))
            if draw.random() < 0.5:  # the loop looks first, or the question does
                assert person.stop()
            else:
                with pytest.raises(EmergencyStop):
                    person.confirm("Is the lung set?")
            assert keyboard.waiting() == 0
            assert not person.stop()


def test_ctrl_z_is_a_stop_and_does_not_suspend(keyboard: Keyboard) -> None:
    person = ConsoleOperator(reaction=0.0)
    with person.keys():
        keyboard.press("\x1a")
        assert person.stop()


@pytest.mark.parametrize(
    ("keys", "confirms"),
    [("y", True), ("Y", True), ("n", False), ("ny", False), ("yn", False), (" ", False)],
)
def test_only_y_by_itself_confirms(keyboard: Keyboard, keys: str, confirms: bool) -> None:
    person = ConsoleOperator(reaction=0.0)
    with person.keys():
        timer = keyboard.press_later(keys, 0.02)
        assert person.confirm("Is the lung set?") is confirms
        timer.join()


def test_a_key_that_is_quicker_than_a_person_is_no_answer(keyboard: Keyboard) -> None:
    person = ConsoleOperator(reaction=0.2)
    with person.keys():
        timer = keyboard.press_later("y", 0.01)
        with pytest.raises(EmergencyStop):
            person.confirm("Is the lung set?")
        timer.join()


def test_a_terminal_that_has_gone_stops_and_confirms_nothing(keyboard: Keyboard) -> None:
    person = ConsoleOperator(reaction=0.0)
    with person.keys():
        keyboard.hang_up()
        assert person.stop()
        with pytest.raises(EmergencyStop):
            person.confirm("Is the lung set?")


def test_keys_of_the_self_test_do_not_raise_the_pressure(
    keyboard: Keyboard, bench: Bench, tmp_path: Path
) -> None:
    person = ConsoleOperator(reaction=0.0)
    plan = make_plan(["a"], ["R5C20"], pips=(10.0,), repeats=1, control_every=0)

    def selftest(lung: str) -> None:
        keyboard.press("yy")

    with person.keys(), RawLog(tmp_path / "raw.jsonl") as log:
        keyboard.press_later("y", 0.02)
        end = run_plan(
            replace(bench, operator=person),
            plan,
            lambda run: pytest.fail("it ran"),
            log,
            about={},
            before_lung=selftest,
        )
    assert end == "the operator pressed the emergency stop"
