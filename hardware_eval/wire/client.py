"""The host's end of the wire: a link that carries bytes, and a client that sends messages over it.

A link is a serial line or a socket that pyserial opens, with errors that say what to do; a thread
carries its bytes (:mod:`hardware_eval.wire.port`).

The client waits for the answer of each message.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import secrets
import time
from collections import deque
from dataclasses import dataclass, replace
from io import UnsupportedOperation
from typing import Protocol, TypeVar, cast
from urllib.parse import urlsplit

import numpy as np
import serial

from hardware_eval.realtime import Clock, RealClock, take_priority
from hardware_eval.wire.messages import (
    PROTOCOL_VERSION,
    Arm,
    Capability,
    Command,
    Counters,
    Event,
    Heartbeat,
    Hello,
    HostMessage,
    Kept,
    Message,
    Mode,
    Packet,
    Reading,
    Reason,
    Refusal,
    Statistics,
    Vent,
    Welcome,
    encode,
    feed_bytes,
    milliseconds,
)
from hardware_eval.wire.port import Port
from ventbench.base.errors import InputError

#: Bits per second; USB devices ignore it. A control step then takes 9 ms of a real UART.
BAUD_RATE = 115_200

#: What a port is.
_PORTS = "write a device such as /dev/ttyACM0, or socket://HOST:PORT"

#: When a port has gone: the first pause between two attempts to open it, s, the factor by which
#: each pause exceeds the one before, and the longest, s.
_PAUSE, _FACTOR, _LONGEST_PAUSE = 0.1, 1.5, 2.0

#: Time that an answer may take, s: most of a control step of 30 ms.
ANSWER_TIMEOUT = 0.020

#: Time for each attempt at hello, arm and vent, which may be repeated safely, s, and attempts: of
#: arm and vent, and of hello, as a board that restarts when its port opens takes up to 3 s.
PATIENCE, ATTEMPTS, HELLOS = 0.2, 5, 15

#: What two clocks may part by in a second, s; crystals do 0.0001. Oldest that a sample may be when
#: the device answers with it, s: then its program has vented. Parting at once from which it is a
#: jump, s.
_DRIFT, _SAMPLE_AGE, _JUMP = 0.002, 0.06, 0.2

#: Round trips that :meth:`Client.round_trips` summarises.
_REMEMBERED = 10_000

AnswerT = TypeVar("AnswerT", Welcome, Reading, Counters)


class LinkError(InputError):
    """The base of all errors of the link."""


class DisconnectedError(LinkError):
    """The port went away while it was open; the device vents by itself."""


class ClockError(LinkError):
    """The device's clock and that of this computer part; its readings are of no known time."""


class DeviceChangedError(InputError):
    """Another device answers, or the same one with another calibration."""


class NoAnswerError(LinkError):
    """The device did not answer in time."""


class RefusedError(LinkError):
    """The device refused a message.

    Attributes:
        refusal: its answer.
    """

    def __init__(self, message: str, refusal: Refusal) -> None:
        """Keep the device's answer."""
        super().__init__(message)
        self.refusal = refusal


class UnconfirmedError(InputError):
    """A real device may not be armed: nobody has confirmed what its valves and its sensor do."""


class Transport(Protocol):
    """Carries bytes to a device and back: a link, or a device in the same process."""

    def write(self, data: bytes) -> None:
        """Send bytes."""
        ...

    def read(self, timeout: float) -> bytes:
        """Wait for bytes; empty if none come within ``timeout``, s."""
        ...

    def close(self) -> None:
        """Release the port."""
        ...

    def reopen(self) -> None:
        """Connect again after a loss."""
        ...

    def raise_lines(self) -> bool:
        """Assert the control lines (DTR, RTS); False if there are none."""
        ...


class Link:
    """An open port.

    Attributes:
        url: a device such as ``/dev/ttyACM0``, or ``socket://host:port``.
    """

    def __init__(self, url: str, patience: float = 60.0) -> None:
        """Open a port.

        Args:
            url: what :func:`serial.serial_for_url` takes and has a descriptor.
            patience: time after which :meth:`reopen` gives up, s.

        Raises:
            LinkError: if it cannot be opened; it says why, and what to do.
        """
        self.url = url
        self._patience = patience
        self._open()

    def write(self, data: bytes) -> None:
        """Send bytes; returns before they are sent. DisconnectedError if the port has gone."""
        if self._traffic.broken:
            raise self._disconnected()
        self._traffic.send(data)

    def read(self, timeout: float) -> bytes:
        """Wait for bytes; empty if none come within ``timeout``, s, or DisconnectedError."""
        data = self._traffic.take(timeout)
        if not data and self._traffic.broken:
            raise self._disconnected()
        return data

    def close(self) -> None:
        """Send what is left, and release the port."""
        self._traffic.close()
        self._port.close()

    def reopen(self) -> None:
        """Open the port again, and try until the patience ends.

        Raises:
            LinkError: the last one, if the port does not come back.
        """
        self.close()
        pause, end = min(_PAUSE, self._patience), time.monotonic() + self._patience
        while True:
            try:
                self._open()
                return
            except LinkError as error:
                if time.monotonic() + pause > end:
                    raise LinkError(f"{error} (tried for {self._patience:g} s)") from error
            time.sleep(pause)
            pause = min(pause * _FACTOR, _LONGEST_PAUSE)

    def raise_lines(self) -> bool:
        """Assert DTR and RTS: boards with USB of their own send nothing without them."""
        try:
            self._port.dtr = self._port.rts = True
        except (OSError, serial.SerialException):
            return False
        return isinstance(self._port, serial.Serial)

    def _open(self) -> None:
        """Open the port, and begin to carry bytes on it until it goes away."""
        try:
            if self.url.startswith("socket:") and urlsplit(self.url).port is None:
                raise ValueError("it has no number")
            port = serial.serial_for_url(self.url, BAUD_RATE, do_not_open=True)
            if isinstance(port, serial.Serial):
                port.exclusive = True  # a second program would steal bytes
                port.dtr = port.rts = False  # asserted, they restart common boards
            port.timeout = 0  # its descriptor is read
            port.open()
            os.set_blocking(port.fileno(), False)
        except ValueError as error:
            why = "no device is behind it" if isinstance(error, UnsupportedOperation) else error
            raise LinkError(f"port {self.url!r}: {why}; {_PORTS}") from error
        except (OSError, serial.SerialException) as error:
            raise self._not_opened(error) from error
        self._port = cast(serial.Serial, port)  # others, such as sockets, have the same methods
        lines = [port.fileno()]
        self._traffic = Port(
            lambda: lines.pop() if lines else None, lambda line: None, take_priority
        )

    def _not_opened(self, error: OSError) -> LinkError:
        number = error.errno or getattr(error.__cause__ or error.__context__, "errno", None)
        if number in (errno.EACCES, errno.EPERM):
            return LinkError(
                f"port {self.url}: you may not open it; join its group (on Debian: sudo usermod "
                "-aG dialout $USER, then log in again)"
            )
        if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "lock" in str(error):
            return LinkError(
                f"port {self.url}: another program has it; close that program (fuser {self.url} "
                "names it)"
            )
        if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.ECONNREFUSED):
            return LinkError(
                f"port {self.url}: it is not there ({error.strerror or error}); is the cable in "
                "and the device on? `python -m serial.tools.list_ports` lists the ports"
            )
        return LinkError(f"port {self.url} cannot be opened: {error}; {_PORTS}")

    def _disconnected(self) -> DisconnectedError:
        return DisconnectedError(f"port {self.url} went away; the device vents the lung by itself")


@dataclass(frozen=True)
class Correction:
    """What calibration makes of readings: ``(reading - offset) / slope``."""

    pressure: tuple[float, float] = (0.0, 1.0)  #: offset, cmH2O, and slope.
    flow: tuple[float, float] = (0.0, 1.0)  #: offset, mL/s, and slope.
    error: float = 0.0  #: half of the 95 % interval of a pressure within the range, cmH2O.

    def of(self, reading: Reading) -> Reading:
        """The reading, corrected."""
        (zero, slope), (offset, gain) = self.pressure, self.flow
        return replace(
            reading,
            pressure=(reading.pressure - zero) / slope,
            flow=(reading.flow - offset) / gain,
        )

    def shown(self, pressure: float) -> float:
        """What the device reads at a pressure, cmH2O."""
        return self.pressure[0] + self.pressure[1] * pressure

    def __str__(self) -> str:
        (zero, slope), (offset, gain) = self.pressure, self.flow
        return (
            f"pressure (reading {-zero:+.2f}) / {slope:.4f}, within {self.error:.2f} cmH2O (95 %); "
            f"flow (reading {-offset:+.1f}) / {gain:.4f}"
        )


class ClockWatch:
    """Compares the clocks of device and host, however late the host is.

    A sample was taken between its question, less what a sample may be old, and its answer: that
    bounds the clocks' offset. All bounds since the session began must agree, but for the drift of
    crystals. Bounds that one old sample contradicts begin anew, until the rate is beyond its error.
    """

    def __init__(self) -> None:
        """Begin with a session."""
        self._low, self._high = -math.inf, math.inf
        self._seen, self._first = 0.0, (math.nan, math.nan)
        self._still, self._age = self._first, 0.0

    def see(self, device: float, asked: float, answered: float) -> str:
        """Look at a reading's device time and the host's times, s; returns what is wrong."""
        elapsed = answered - self._seen
        if math.isnan(self._first[0]):
            self._first = device, asked
        if device != self._still[0]:
            self._still = device, asked
        self._low -= _DRIFT * elapsed
        self._high += _DRIFT * elapsed
        low, high = asked - _SAMPLE_AGE - device, answered - device
        apart = max(low - self._high, self._low - high)
        self._low, self._high = max(self._low, low), min(self._high, high)
        self._seen = answered
        if apart <= 0.0:
            return ""
        if (still := asked - self._still[1]) > _SAMPLE_AGE:
            return f"the device's clock, or its sensor, has stood still for {still:.2g} s"
        if apart > _JUMP:
            return f"the device's clock jumped by {apart:.2g} s against this computer's"
        passed, self._age = asked - self._first[1], max(self._age, 2.0 * _SAMPLE_AGE + apart)
        rate, error = (device - self._first[0]) / passed - 1.0, self._age / passed
        if abs(rate) <= error:  # a sample may be so old, where host and device are one computer
            self._low, self._high = low, high
            return ""
        speed = "fast" if rate > 0.0 else "slow"
        return f"the device's clock is {100 * abs(rate):.1f} (+-{100 * error:.1f}) % too {speed}"


class Client:
    """A session with one device.

    Every method sends one message and waits for its answer, by the clock it was given. All raise
    NoAnswerError if the device does not answer in time, DisconnectedError if the port goes away,
    and RefusedError if the session is not open or the device refuses for another cause.

    Attributes:
        transport: what carries the bytes.
        welcome: what the device told at the last :meth:`hello`; None before.
        reading: the newest reading; None before the first.
        vented: whether the last answer was of a device that has vented.
        brought_up: device and calibration that a person has confirmed
            (:mod:`hardware_eval.bench.bringup`); without it no real device is armed.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock | None = None,
        timeout: float = ANSWER_TIMEOUT,
        emulated: bool = True,
    ) -> None:
        """Talk through a :class:`Link` or a loopback device.

        The latter needs its own clock. An answer may take ``timeout``, s. Only at a port where
        software may be (``emulated``) a device is believed that says it is simulated.
        """
        self.brought_up: dict[str, str] | None = None
        self._emulated = emulated
        self.welcome: Welcome | None = None
        self.reading: Reading | None = None
        self.transport, self._clock, self._timeout = transport, clock or RealClock(), timeout
        self._kept: Kept = None
        self._session, self._sequence = 0, 0
        self._round_trips: deque[float] = deque(maxlen=_REMEMBERED)
        self._pressure_limit: float | None = None
        self._watch = ClockWatch()
        self._correction = Correction()
        self.vented = False

    def hello(self, pressure_limit: float | None = None) -> Welcome:
        """Open a new session; the device vents. It refuses another protocol version.

        Args:
            pressure_limit: pressure above which the device shall vent, cmH2O, if it is below the
                device's own limit.

        Raises:
            DeviceChangedError: if it is not the device of the session before.
        """
        before = self.welcome
        self._session, self._sequence = secrets.randbits(32), 0
        self._pressure_limit, self._watch = pressure_limit, ClockWatch()
        shown = None if pressure_limit is None else self._correction.shown(pressure_limit)
        hello = Hello(PROTOCOL_VERSION, shown)
        try:
            self.welcome = self._persist(hello, Welcome, HELLOS)
        except NoAnswerError:
            if not self.transport.raise_lines():
                raise
            self.welcome = self._persist(hello, Welcome, HELLOS)
        if before is not None and self.welcome.device != before.device:
            now, then = (
                f"{x.name} {x.device_id.hex()} with calibration {x.calibration.hex()[:8]}"
                for x in (self.welcome, before)
            )
            raise DeviceChangedError(
                f"the device is {now}; the session began with {then}: begin a new one"
            )
        self._persist(Heartbeat(), Reading)
        return self.welcome

    def calibrate(self, correction: Correction) -> None:
        """Correct all readings from here on, and open a session whose limit is so too.

        The device compares what its sensor reads, so it is told the reading at its limit.
        """
        limit = self._pressure_limit or self.identity.pressure_limit
        self._correction = correction
        self.hello(limit)

    @property
    def identity(self) -> Welcome:
        """What the device tells of itself; it is asked if it has not been yet."""
        return self.welcome or self.hello()

    @property
    def simulated(self) -> bool:
        """Whether no valve moves, so that nobody need have confirmed what moves."""
        says = self.welcome is not None and bool(self.welcome.capabilities & Capability.SIMULATED)
        return says and self._emulated

    def arm(self) -> Reading:
        """Begin a run: clear the causes of venting; commands must follow within 80 ms.

        The device refuses while a cause of venting lasts. A session that was lost, to another host
        or by a restart of the device, is opened again.

        Raises:
            UnconfirmedError: if the device is real, and was not brought up as it is now.
        """
        if not self.simulated and (self.welcome is None or self.welcome.device != self.brought_up):
            raise UnconfirmedError(
                "nobody has confirmed what the valves and the sensor of this device do, as it is "
                "configured now: run `ventbench-hardware bringup --port PORT`; nothing was armed"
            )
        try:
            return self._persist(Arm(), Reading)
        except RefusedError as error:
            if error.refusal.reason is not Reason.SESSION:
                raise
            self.hello(self._pressure_limit)
            return self._persist(Arm(), Reading)

    def command(self, u_in: float, u_out: int, timeout: float | None = None) -> Reading:
        """Set the valves, and return what the device applied, as it was when the command arrived.

        If the device refuses, the lung is or will be vented; if it does not answer, it may have
        obeyed.

        Args:
            u_in: inspiratory valve, %.
            u_out: expiratory valve, 0 closed, 1 open.
            timeout: time that the answer may take, s, if it is another than the client's.

        Raises:
            ValueError: if a value cannot be sent.
        """
        seen = 0 if self.reading is None else milliseconds(self.reading.time)
        return self._ask(
            Command(u_in, u_out, seen), Reading, self._timeout if timeout is None else timeout
        )

    def heartbeat(self) -> Reading:
        """Take a fresh reading; moves no valve and does not feed the watchdog."""
        return self._ask(Heartbeat(), Reading, self._timeout)

    def vent(self) -> Reading:
        """Vent the lung until :meth:`arm`; works without a session too.

        Where this fails, the device's watchdog vents by itself.
        """
        return self._persist(Vent(), Reading)

    def counters(self) -> Counters:
        """Return the device's error counters."""
        return self._ask(Statistics(), Counters, self._timeout)

    def reconnect(self) -> Welcome:
        """Connect again after a loss, as patiently as the link is, and open a new session.

        Raises:
            LinkError: if the port does not come back.
        """
        self.transport.reopen()
        self._kept = None
        return self.hello(self._pressure_limit)

    def close(self) -> None:
        """Vent if the device still listens, and release the port."""
        try:
            with contextlib.suppress(LinkError):
                self.vent()  # else the watchdog vents
        finally:
            self.transport.close()

    def ending(self) -> str:
        """Whether the lung is vented, as far as is known, in words."""
        if self.vented:
            return "the lung is vented: the device said so"
        return (
            "whether the lung is vented is not known, as the device does not answer: its watchdog "
            "vents after 0.1 s; look at the lung"
        )

    def round_trips(self) -> tuple[float, float]:
        """Median and longest time from message to answer of the last ten thousand, s, or NaN."""
        trips = np.asarray(self._round_trips if self._round_trips else [np.nan])
        return float(np.median(trips)), float(np.max(trips))

    def _persist(
        self, message: HostMessage, answer: type[AnswerT], attempts: int = ATTEMPTS
    ) -> AnswerT:
        while True:
            attempts -= 1
            try:
                return self._ask(message, answer, PATIENCE)
            except NoAnswerError:
                if not attempts:
                    raise

    def _ask(self, message: HostMessage, answer: type[AnswerT], timeout: float) -> AnswerT:
        self._sequence += 1
        frame = encode(Packet(self._session, self._sequence, message))
        begun, self.vented = self._clock.now(), False
        self.transport.write(frame)
        answered = self._wait(begun + timeout)
        name = type(message).__name__.lower()
        if answered is None:
            raise NoAnswerError(
                f"the device did not answer {name} within {1000 * timeout:.0f} ms: is it on, and "
                "does its program run?"
            )
        now = self._clock.now()
        self._round_trips.append(now - begun)
        if isinstance(answered, Reading):
            answered = self._correction.of(answered)
            self.reading, self.vented = answered, answered.mode is not Mode.RUNNING
            if wrong := self._watch.see(answered.time, begun, now):
                self._watch = ClockWatch()
                raise ClockError(f"{wrong}; no reading of it can be placed in time")
        if isinstance(answered, Refusal):
            self.vented = answered.mode is not Mode.RUNNING
            causes = f" (vented by {answered.flags.name})" if answered.flags else ""
            if answered.reason is Reason.SESSION:
                causes += "; another host, or a restart of the device, ended the session"
            raise RefusedError(
                f"the device refused {name}: {answered.reason.name}, mode {answered.mode.name}"
                f"{causes}",
                answered,
            )
        if not isinstance(answered, answer):
            raise NoAnswerError(
                f"the device answered {name} with {type(answered).__name__}, which is no answer to "
                "it: its program does not follow PROTOCOL.md"
            )
        return answered

    def _wait(self, deadline: float) -> Message | None:
        while True:
            left = deadline - self._clock.now()
            if left <= 0.0:
                return None
            self._kept, events = feed_bytes(self._kept, self.transport.read(left))
            answers = [message for event in events if (message := self._expected(event))]
            if answers:
                return answers[-1]

    def _expected(self, event: Event) -> Message | None:
        """The message of an answer; None of what was damaged, or answers nothing that waits."""
        waits = self._session, self._sequence
        if isinstance(event, Packet) and (event.session, event.sequence) == waits:
            return event.message
        return None
