"""Run the device's program on a ventilator: ``python -m hardware_eval.device --help``."""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from hardware_eval import realtime
from ventbench.base.errors import InputError

try:
    from hardware_eval.device import deadman
    from hardware_eval.device.guard import Guard
    from hardware_eval.device.program import DeviceService
    from hardware_eval.wire.client import BAUD_RATE
    from hardware_eval.wire.port import Port
except InputError as missing:  # an extra that brings the wire
    print(f"python -m hardware_eval.device: {missing}", file=sys.stderr)
    raise SystemExit(2) from None


def open_serial(path: str) -> int | None:
    """Open a serial port; returns its descriptor, or None while it is not there."""
    import serial

    try:
        port = serial.Serial(path, BAUD_RATE, exclusive=True)
    except serial.SerialException:
        return None
    descriptor = os.dup(port.fileno())
    port.close()
    os.set_blocking(descriptor, False)
    return descriptor


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program on the People's Ventilator; returns the exit code."""
    parser = argparse.ArgumentParser(
        "python -m hardware_eval.device",
        description="Guard the lung on a ventilator and do what a host asks.",
        epilog="Example: python -m hardware_eval.device --config pvp.toml --port /dev/ttyGS0",
    )
    parser.add_argument("--config", type=Path, required=True, help="TOML file of the ventilator")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--port", help="serial port to the host, such as /dev/ttyGS0")
    where.add_argument(
        "--vent", action="store_true", help="vent once and end (for ExecStopPost of systemd)"
    )
    given = parser.parse_args(arguments)
    try:
        return _run(given)
    except (InputError, ValueError) as error:
        print(f"python -m hardware_eval.device: {error}", file=sys.stderr)
        return 2


def _run(given: argparse.Namespace) -> int:
    from hardware_eval.device.pvp import PvpSensor, PvpValves

    PvpValves(given.config).close()  # vented; what is wrong with them is told here
    if given.vent:
        return 0
    sensor = PvpSensor(given.config)
    process, orders = deadman.start(
        f"{PvpValves.__module__}:{PvpValves.__name__}", str(given.config)
    )
    hal = deadman.SupervisedHal(sensor, orders)
    try:
        if reason := realtime.prefer():
            print(f"no real-time scheduling: {reason}", file=sys.stderr)
        ended = realtime.told_to_end()
        with contextlib.closing(Port(lambda: open_serial(given.port), os.close)) as port:
            awake = notifier()
            service = DeviceService(hal, time.monotonic(), sensor.pressure_limit)
            Guard(service, port).run(lambda: ended() or hal.lost or awake())
    finally:
        hal.close()
        process.wait()
        sensor.close()
    if hal.lost:
        PvpValves(given.config).close()  # the deadman could not
        print("the deadman has gone; vented", file=sys.stderr)
    return int(hal.lost)


def notifier() -> Callable[[], bool]:
    """Tell systemd that the program is ready, and then, whenever called, that it is awake.

    Returns:
        What to call in the loop; it tells four times in systemd's ``WatchdogSec`` and is False. It
        does nothing where systemd did not ask.
    """
    path, period = os.environ.get("NOTIFY_SOCKET"), os.environ.get("WATCHDOG_USEC")
    told = time.monotonic()
    if path is None:
        return lambda: False
    address = "\0" + path[1:] if path.startswith("@") else path

    def tell(state: bytes) -> None:
        with (
            contextlib.suppress(OSError),  # it is busy; the next one will do
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd,
        ):
            systemd.setblocking(False)
            systemd.sendto(state, address)

    def awake() -> bool:
        nonlocal told
        now = time.monotonic()
        if period and now - told > 0.25e-6 * float(period):
            told = now
            tell(b"WATCHDOG=1")
        return False

    tell(b"READY=1")
    return awake


if __name__ == "__main__":
    sys.exit(main())
