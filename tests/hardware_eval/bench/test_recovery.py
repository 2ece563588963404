"""What ends a session's hold of its device, and how it is taken again; and clocks that part."""

from __future__ import annotations

import io
import math
import re
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from hardware_eval.bench.console import ConsoleOperator, show_bars
from hardware_eval.bench.loop import BreathLog, Operator
from hardware_eval.bench.plan import PlannedRun
from hardware_eval.wire.client import (
    Client,
    ClockWatch,
    DeviceChangedError,
    Link,
    NoAnswerError,
    RefusedError,
)
from hardware_eval.wire.messages import Mode
from tests.hardware_eval import stand_in
from tests.hardware_eval.bad_day import Board, bad_day
from tests.hardware_eval.faults import FaultyDevice


def test_a_board_that_restarts_when_its_port_opens_passes() -> None:
    board = Board(FaultyDevice(stand_in.Bench()))
    client = Client(board, board.clock)
    assert client.hello().name == "bench"
    assert board.clock.now() - board.device.start < 3.0
    client.reconnect()
    assert board.restarts == 2
    assert client.arm().mode is Mode.RUNNING


def test_a_board_that_wants_its_lines_gets_them_and_silence_is_an_error() -> None:
    board = Board(FaultyDevice(stand_in.Bench()), needs_lines=True)
    assert Client(board, board.clock).hello().name == "bench"
    board.ready = math.inf
    with pytest.raises(NoAnswerError, match="hello"):
        Client(board, board.clock).hello()


def test_a_port_is_opened_with_the_lines_down_that_restart_boards(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[tuple[bool, bool]] = []

    def opened(port: serial.Serial) -> None:
        seen.append((port.dtr, port.rts))
        raise FileNotFoundError(2, "no such port")

    monkeypatch.setattr(serial.Serial, "open", opened)
    with pytest.raises(Exception, match="not there"):
        Link("/dev/ttyACM7")
    assert seen == [(False, False)]


def test_a_lost_session_is_opened_again_by_arming_and_by_nothing_else() -> None:
    device = FaultyDevice(stand_in.Bench())
    client, other = Client(device, device.clock), Client(device, device.clock)
    client.hello(40.0)
    client.arm()
    other.hello()
    with pytest.raises(RefusedError, match=r"SESSION.*another host"):
        client.command(10.0, 0)
    with pytest.raises(RefusedError, match="SESSION"):
        client.heartbeat()
    assert client.arm().mode is Mode.RUNNING
    assert device.service.state.pressure_limit == 40.0
    hal: Any = device.service.hal
    hal.identity = replace(hal.identity, calibration=bytes(31) + b"1")
    with pytest.raises(DeviceChangedError, match="begin a new one"):
        client.hello()


def test_the_end_says_whether_the_lung_is_vented() -> None:
    device = FaultyDevice(stand_in.Bench())
    client = Client(device, device.clock)
    client.hello()
    client.arm()
    assert "not known" in client.ending()
    client.close()
    assert "is vented" in client.ending()
    device.unplug()
    client.close()
    assert "watchdog" in client.ending()


#: The last three were lost when restarts counted as spoilt runs, and two lost readings as a fault.
@pytest.mark.parametrize(
    ("seed", "repeats"), [*((seed, 3) for seed in range(8)), (51, 1), (91, 1), (489, 1)]
)
def test_a_session_survives_a_bad_day(tmp_path: Path, seed: int, repeats: int) -> None:
    day = bad_day(tmp_path / "raw.jsonl", seed, repeats)
    assert (day.reason, day.lost, day.vented) == ("", 0, True)


class Steps:
    """Questions to a device whose clock is a function of the host's."""

    def __init__(self, seed: int, period: float = 0.03) -> None:
        self.draw, self.period, self.watch, self.now = Random(seed), period, ClockWatch(), 0.0

    def until(self, end: float, clock: Any, worst: float = 0.5) -> str:
        """What is said until then; answers are late by up to ``worst``, s, samples old."""
        while self.now < end:
            asked = self.now
            answered = asked + self.draw.uniform(0.0, self.draw.choice((0.004, worst)))
            sampled = self.draw.uniform(asked, answered) - self.draw.uniform(0.0, 0.05)
            if said := self.watch.see(clock(sampled), asked, answered):
                return said
            self.now = max(answered, asked + self.period)
        return ""


@given(st.integers(0, 10**6), st.floats(-2e-4, 2e-4), st.floats(-1e6, 1e6))
def test_a_clock_of_a_crystal_is_never_blamed_however_late_the_host_is(
    seed: int, drift: float, offset: float
) -> None:
    assert Steps(seed).until(30.0, lambda t: offset + (1.0 + drift) * t) == ""


@given(st.integers(0, 10**6), st.sampled_from([-0.01, 0.01]))
def test_a_clock_that_is_one_percent_off_is_named(seed: int, off: float) -> None:
    said = Steps(seed).until(30.0, lambda t: (1.0 + off) * t, worst=0.02)
    rate = re.search(r"is ([\d.]+) \(\+-([\d.]+)\) % too (fast|slow)", said)
    assert rate, said
    assert abs(float(rate[1]) - 1.0) <= float(rate[2])
    assert rate[3] == ("fast" if off > 0.0 else "slow")


@given(st.integers(0, 10**6), st.floats(0.4, 1e4), st.sampled_from([-1.0, 1.0]))
def test_a_clock_that_jumps_or_stands_still_is_named(seed: int, by: float, sign: float) -> None:
    steps = Steps(seed)
    assert steps.until(3.0, lambda t: t, worst=0.02) == ""
    said = steps.until(4.0, lambda t: t + (sign * by if t > 3.0 else 0.0), worst=0.02)
    assert "jumped by" in said
    assert "stood still" in Steps(seed).until(3.0, lambda t: 7.0, worst=0.02)


def test_a_clock_is_not_blamed_for_a_sample_that_is_old() -> None:
    """A computer that is busy holds up an emulated device: of 0.03 s nothing tells a rate."""
    for old, off in ((0.0, 0.13), (0.13, 0.0)):  # the first sample, or the second
        steps = Steps(0)
        assert steps.watch.see(-off, 0.0, 0.004) == ""
        assert steps.watch.see(0.03 - old, 0.03, 0.034) == ""
        steps.now = 0.06
        assert steps.until(30.0, lambda t: t) == ""
        steps.now = 30.0
        assert "too fast" in steps.until(60.0, lambda t: 30.0 + 1.02 * (t - 30.0), worst=0.02)


def test_a_terminal_without_blocks_shows_bars_of_letters(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(raw, "ascii"))
    breath = BreathLog(pressure=[5.0, 10.0, 20.0], late=[0.0])
    show_bars(PlannedRun(0, "scored", "a", "R5C20", 20.0, 1), breath, 0, 1)
    assert raw.getvalue().rstrip().endswith(b"| :*|")


def test_a_person_is_not_asked_for_numbers_where_nobody_is() -> None:
    for person in (Operator(), ConsoleOperator(yes=True)):
        with pytest.raises(Exception, match="nobody is there"):
            person.number("the meter, mL/s: ")
