"""The emulator on a real pseudo-terminal, and the link's errors; without the lung's simulator."""

from __future__ import annotations

import errno
import os
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hardware_eval.device.program import DeviceService
from hardware_eval.wire.client import (
    Client,
    DisconnectedError,
    Link,
    LinkError,
    NoAnswerError,
    RefusedError,
)
from hardware_eval.wire.messages import Flag, Mode, Packet, Vent, encode
from tests.hardware_eval.electronics import LoggedEmulator
from tests.hardware_eval.stand_in import Bench

#: Patience with a busy machine, s; a healthy one needs a thousandth of it.
PATIENCE = 600.0


class PulledEmulator(LoggedEmulator):
    """An emulator whose cable can be pulled."""

    def _open(self) -> int:
        self.line = super()._open()
        return self.line

    def pull(self, seconds: float) -> None:
        """Break the line, and let it be opened again after a time, s."""
        self.port._absent_until = time.monotonic() + seconds
        with open(os.devnull, "rb") as ended:
            os.dup2(ended.fileno(), self.line)  # all that comes from it is its end
        self.port.send(b"")


@pytest.fixture
def emulator(tmp_path: Path) -> Iterator[PulledEmulator]:
    service = DeviceService(Bench(), 0.0)
    running = PulledEmulator(
        service, tmp_path / "valves.csv", link=tmp_path / "lung", begun=time.monotonic()
    )
    stop = threading.Event()
    thread = threading.Thread(target=running.run, args=(stop.is_set,))
    thread.start()
    yield running
    stop.set()
    thread.join()


def _wait_for(done: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < end
        time.sleep(0.002)


def _vented(emulator: PulledEmulator) -> bool:
    """Whether its program has vented; the log of its orders follows only after the answer."""
    service: Any = emulator.service
    return service.state.mode is Mode.VENTED


def _run(client: Client) -> None:
    """Arm and set the valves; again if the busy machine was so slow that the watchdog vented."""
    for _ in range(100):
        client.arm()
        try:
            if client.command(20.0, 0).mode is Mode.RUNNING:
                return
        except (NoAnswerError, RefusedError):
            continue
    pytest.fail("the device never ran")


def test_a_session_on_a_pseudo_terminal(emulator: PulledEmulator, tmp_path: Path) -> None:
    client = Client(Link(emulator.terminal), timeout=PATIENCE)
    assert client.hello().name == "bench"
    _run(client)
    # The host dies: nothing is said any more.
    _wait_for(lambda: _vented(emulator))
    service: Any = emulator.service
    assert Flag.COMMANDS_STOPPED in service.state.causes
    with pytest.raises(RefusedError, match="NOT_ARMED"):
        client.command(10.0, 0)
    client.close()
    u_in, u_out, causes = (tmp_path / "valves.csv").read_text().split()[-1].split(",")[1:]
    assert (u_in, u_out) == ("0", "1")
    assert "COMMANDS_STOPPED" in causes.split("|")  # and that a busy machine was late


def test_a_cable_is_pulled_and_comes_back(emulator: PulledEmulator) -> None:
    client = Client(Link(emulator.terminal), timeout=PATIENCE)
    client.hello()
    _run(client)
    emulator.pull(0.3)
    with pytest.raises(DisconnectedError):
        _wait_for(lambda: client.heartbeat().mode is None)
    _wait_for(lambda: _vented(emulator))
    client.reconnect()
    _run(client)
    client.close()


def test_a_line_that_cannot_be_opened_is_told_and_tried_again(
    emulator: PulledEmulator, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    told = ""

    def failed() -> bool:
        nonlocal told
        told += capfd.readouterr().err
        return "cannot be opened" in told

    taken = tmp_path / "lung"
    emulator._link = tmp_path / "valves.csv" / "lung"  # no folder can be made there
    emulator.pull(0.0)
    _wait_for(failed)
    taken.unlink()
    emulator._link = taken
    _wait_for(taken.exists)
    assert Client(Link(str(taken)), timeout=PATIENCE).hello().name == "bench"


def test_errors_of_ports(
    emulator: PulledEmulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(LinkError, match="is the cable in"):
        Link(str(tmp_path / "none"))
    with pytest.raises(LinkError, match="socket://"):
        Link("nonsense://x")
    plain = tmp_path / "file"
    plain.touch()
    with pytest.raises(LinkError, match="cannot be opened"):
        Link(str(plain))
    first = Link(emulator.terminal)
    with pytest.raises(LinkError, match="another program has it"):
        Link(emulator.terminal)
    first.close()

    def forbidden(*_: object, **__: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", forbidden)
    with pytest.raises(LinkError, match="dialout"):
        Link(emulator.terminal)


def test_patience_with_a_lost_port_ends(emulator: PulledEmulator, tmp_path: Path) -> None:
    link = Link(emulator.terminal, patience=0.05)
    (tmp_path / "lung").unlink()
    with pytest.raises(LinkError, match=r"tried for 0\.05 s"):
        link.reopen()


def test_a_socket_is_a_link_too_and_what_has_no_descriptor_is_none() -> None:
    with pytest.raises(LinkError, match="socket://"):
        Link("loop://")
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = Link(f"socket://127.0.0.1:{server.getsockname()[1]}")
        device, _ = server.accept()
        with device:
            link.write(encode(Packet(0, 1, Vent())))
            assert device.recv(100) == encode(Packet(0, 1, Vent()))
            assert link.read(0.001) == b""
            device.sendall(b"abc")
            assert link.read(PATIENCE) == b"abc"
        with pytest.raises(DisconnectedError, match="vents the lung by itself"):
            link.read(PATIENCE)
        link.close()


def test_what_was_written_is_sent_before_the_port_is_released() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    for k in range(50):
        link = Link(os.ttyname(slave))
        link.write(bytes([k]) * 40)
        link.close()
        link.close()
        link.write(b"lost")
        assert os.read(master, 100) == bytes([k]) * 40
    os.close(slave)
    os.close(master)
