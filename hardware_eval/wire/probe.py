"""A host that may send anything and hears everything, for judging a device."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from random import Random
from typing import TypeVar

from hardware_eval.realtime import Clock
from hardware_eval.wire.client import Transport
from hardware_eval.wire.messages import (
    Arm,
    Command,
    Counters,
    Flag,
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
    Welcome,
    encode,
    feed_bytes,
    milliseconds,
)

#: From the last command to moved valves, s; the watchdog; and the time for an answer.
BOUND, WATCHDOG, ANSWER = 0.100, 0.080, 0.005

#: Largest step of the sequence number.
WINDOW = 65_536

#: Causes of venting that pass by themselves.
_SENSOR = Flag.SENSOR_LOST | Flag.SENSOR_STUCK | Flag.SENSOR_NOISY

#: Patience with an answer, s.
_PATIENCE = 0.5

_AnswerT = TypeVar("_AnswerT", Welcome, Reading, Refusal, Counters)


class LateError(Exception):
    """The host was too slow for the check."""


class DiffersError(Exception):
    """The device does otherwise; the text says how."""


class UntriedError(Exception):
    """The check does not apply; the text says why."""


class Probe:
    """A session with a device.

    Attributes:
        transport: carries bytes to the device and back.
        clock: of the transport.
        random: draws session numbers.
        session: number of the open session.
        sequence: last sequence number that the device has consumed.
        watchdog: what the device told at the last hello, s.
        heard: packets that nobody has asked for yet.
        fed: when the device's watchdog started at the earliest, s; infinite where it cannot vent,
            or may. An answer that comes when it can have run out says nothing of what was asked.
    """

    def __init__(self, transport: Transport, clock: Clock) -> None:
        """Begin on a transport by its clock."""
        self.transport, self.clock, self.random = transport, clock, Random(0)
        self.session = self.sequence = 0
        self.watchdog = WATCHDOG
        self._kept: Kept = None
        self.heard: list[Packet] = []
        self.fed = math.inf

    def hello(self, limit: float | None = None) -> Welcome:
        """Open a session of another number."""
        self.session, self.sequence = self.random.getrandbits(32), 0
        welcome = self.ask(Hello(pressure_limit=limit), Welcome)
        self.watchdog, self.fed = welcome.watchdog, math.inf
        return welcome

    def frame(self, message: Message, step: int = 1) -> bytes:
        """The frame of a message; its sequence number is ``step`` above the last one consumed."""
        return encode(Packet(self.session, self.sequence + step, message))

    def ask(
        self,
        message: HostMessage,
        answer: type[_AnswerT],
        step: int = 1,
        session: int | None = None,
    ) -> _AnswerT:
        """Send a message, and return its answer, which must be of a type.

        The device consumes its number if ``step`` is one that a number may rise by, and no other
        ``session`` is given.
        """
        header = self.session if session is None else session, self.sequence + step
        sent, got = self.clock.now(), self.raw(encode(Packet(*header, message)))
        self.in_time()
        if (got.session, got.sequence) != header:
            raise DiffersError(
                f"{told(message)} {header[1]} of session {header[0]:#x} was answered "
                f"with number {got.sequence} of session {got.session:#x}"
            )
        self.sequence += step if session is None and 0 < step <= WINDOW else 0
        if not isinstance(got.message, answer):
            raise DiffersError(
                f"{told(message)} was answered with {told(got.message)}, not with "
                f"{answer.__name__.lower()}"
            )
        if isinstance(got.message, Reading | Refusal) and got.message.mode is not Mode.RUNNING:
            self.fed = math.inf
        elif isinstance(got.message, Reading) and isinstance(message, Arm | Command):
            self.fed = sent
        return got.message

    def refused(
        self, message: HostMessage, reason: Reason, step: int = 1, session: int | None = None
    ) -> Refusal:
        """Send what must be refused for a reason."""
        got = self.ask(message, Refusal, step, session)
        equal(f"{told(message)} refused for", got.reason.name, reason.name)
        return got

    def raw(self, data: bytes) -> Packet:
        """Send bytes; return the first packet of the device."""
        self.transport.write(data)
        return self.next()

    def next(self) -> Packet:
        """The next packet of the device."""
        if not self.heard:
            self.heard = self.hear(_PATIENCE, first=True)
        if self.heard:
            return self.heard.pop(0)
        raise DiffersError(f"no answer within {1000 * _PATIENCE:.0f} ms")

    def hear(self, seconds: float, first: bool = False) -> list[Packet]:
        """What the device sends within a time; with ``first``, until it has sent something."""
        end, heard = self.clock.now() + seconds, []
        while (left := end - self.clock.now()) > 0.0 and not (first and heard):
            self._kept, events = feed_bytes(self._kept, self.transport.read(left))
            faults = [event for event in events if not isinstance(event, Packet)]
            if faults:
                raise DiffersError(f"the device sent what is no frame ({faults[0].value})")
            heard += [event for event in events if isinstance(event, Packet)]
        return heard

    def reading(self) -> Reading:
        """The device's state."""
        return self.ask(Heartbeat(), Reading)

    def counters(self) -> Counters:
        """The device's counters."""
        return self.ask(Statistics(), Counters)

    def arm(self) -> None:
        """Begin a run."""
        self.fed = self.clock.now()
        got = self.raw(self.frame(Arm())).message
        self.sequence += 1
        if isinstance(got, Refusal) and got.flags & _SENSOR:
            raise LateError  # what the check before did to the lung
        if not isinstance(got, Reading):
            raise DiffersError(f"arm was answered with {told(got)}")
        equal("mode after arming", got.mode.name, "RUNNING")

    def inspire(self) -> None:
        """Arm and open the inspiratory valve."""
        self.arm()
        self.ask(self.command(30.0, 0), Reading)

    @contextlib.contextmanager
    def counting(self, **more: int) -> Iterator[None]:
        """Compare how much counters rise meanwhile."""
        before = self.counters()
        yield
        after = self.counters()
        for name, wanted in more.items():
            equal(f"counter {name}", getattr(after, name) - getattr(before, name), wanted)

    def command(self, u_in: float, u_out: int, age: int = 0) -> Command:
        """A command that rests on the reading of this moment, or on one ``age`` ms older."""
        newest = milliseconds(self.reading().time)
        return Command(u_in, u_out, (newest - age) & 0xFFFFFFFF)

    def in_time(self) -> None:
        """Go on only if the watchdog cannot have run out."""
        if self.clock.now() - self.fed > WATCHDOG - ANSWER:
            raise LateError


def told(message: object) -> str:
    """A message in words."""
    if isinstance(message, Refusal):
        return f"a refusal ({message.reason.name})"
    return type(message).__name__.lower()


def equal(what: str, got: object, wanted: object) -> None:
    """Raise DiffersError unless both are equal."""
    if got != wanted:
        raise DiffersError(f"{what}: {got}, not {wanted}")
