"""Does a device follow PROTOCOL.md? The specification as a list of checks over the wire.

Written from the specification, with nothing of a device but the codec of the wire. Every check
begins a session of its own. What a slow host could spoil is judged by bounds that lateness cannot
move, and is otherwise tried again: an answer that came before the watchdog's time shows that the
device had no reason to vent, and a question that was asked after its bound that it must have. So is
a check in which sensor or pressure made the device vent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

from hardware_eval.realtime import Clock
from hardware_eval.wire.client import NoAnswerError, Transport
from hardware_eval.wire.messages import (
    LONGEST_FRAME,
    LONGEST_PACKET,
    Arm,
    Capability,
    Command,
    Counters,
    Flag,
    Heartbeat,
    Hello,
    Mode,
    Packet,
    Reading,
    Reason,
    Refusal,
    Statistics,
    Vent,
    Welcome,
    to_frame,
    to_packet,
    with_crc,
)
from hardware_eval.wire.probe import (
    ANSWER,
    BOUND,
    WATCHDOG,
    WINDOW,
    DiffersError,
    LateError,
    Probe,
    UntriedError,
    equal,
    told,
)

#: Attempts at a check that a slow host spoils.
_ATTEMPTS = 20

#: What no host can provoke over the wire.
NOT_TRIED = (
    "no valid pressure for 50 ms vents (duty 2)",
    "a reading that stands for 250 ms vents, if the sensor has noise (duty 2)",
    "noise above 1 cmH2O vents (duty 2)",
    "the end of the sensor's range vents, and a limit beyond it bars arming (duty 2)",
    "a device that was held up vents before it listens (duty 3)",
)


def _shows(
    seen: Reading | Refusal, what: str, mode: Mode, u_in: float = 0.0, u_out: int = 1
) -> None:
    equal(f"mode {what}", seen.mode.name, mode.name)
    if isinstance(seen, Reading):
        equal(f"valves {what}", (seen.u_in, seen.u_out), (u_in, u_out))


def _vented(reading: Reading | Refusal, what: str, flags: Flag | None = None) -> None:
    _shows(reading, what, Mode.VENTED)
    if flags is not None:
        equal(f"flags {what}", reading.flags & ~Flag.SATURATED, flags)


def _counted(host: Probe, data: bytes, **more: int) -> None:
    """Send what must not be answered, and be counted."""
    before = host.counters()
    host.transport.write(data)
    after = host.counters()  # the next answer is this one
    for name in ("frames", "framing", "checksum", "malformed"):
        wanted = (getattr(before, name) + more.get(name, 0) + (name == "frames")) & 0xFFFFFFFF
        equal(f"counter {name} after {data[:12].hex(' ')}..", getattr(after, name), wanted)


# Frames.


def _garbage(host: Probe) -> None:
    host.transport.write(b"\xff" * 700)
    host.reading()
    host.transport.write(bytes(range(1, 256)))
    host.reading()


def _pieces(host: Probe) -> None:
    for byte in host.frame(Heartbeat()):
        host.transport.write(bytes([byte]))
    host.next()
    host.sequence += 1
    first, second = host.frame(Heartbeat(), 1), host.frame(Heartbeat(), 2)
    numbers = [host.raw(first[:-1] + second).sequence, host.next().sequence]
    equal("two frames answered", numbers, [host.sequence + 1, host.sequence + 2])
    host.sequence += 2


def _faulty(host: Probe) -> None:
    content = to_packet(Packet(host.session, 1, Heartbeat()))[:-4]
    wrong = to_frame(content + b"\x01\x02\x03\x04")
    _counted(host, b"\0\x09\x01\x02\0", framing=1)
    _counted(host, b"\0" + b"\x01" * (LONGEST_FRAME + 1) + b"\0", framing=1)
    _counted(host, wrong, checksum=1)
    _counted(host, b"\0\x02\x01\0", checksum=1)


def _malformed(host: Probe) -> None:
    # Hello, arm, command, heartbeat, vent and statistics, and how long their bodies are.
    lengths = {0x01: 3, 0x02: 0, 0x03: 7, 0x04: 0, 0x05: 0, 0x06: 0}
    wrong = [
        (kind, size)
        for kind, length in lengths.items()
        for size in {length + 1, max(length - 1, 1)} - {length}
    ]
    wrong += [(kind, LONGEST_PACKET - 4 - 9) for kind in (0x00, 0x07, 0x7F, 0x80, 0xFF)]
    header = host.session.to_bytes(4, "little") + (host.sequence + 9).to_bytes(4, "little")
    for kind, size in wrong:
        _counted(host, to_frame(with_crc(bytes([kind]) + header + bytes(size))), malformed=1)
    echo = Reading(1.0, 5.0, math.nan, 0.0, 1, Mode.READY, Flag.NONE)
    _counted(host, host.frame(echo), malformed=1)


def _silent(host: Probe) -> None:
    if heard := host.hear(0.15):
        raise DiffersError(f"the device sent {told(heard[0].message)} without a question")
    host.arm()
    if heard := host.hear(0.15):
        raise DiffersError(f"the device sent {told(heard[0].message)} when it vented")


# Sessions and numbers.


def _welcome(host: Probe) -> None:
    own = host.hello()
    equal("protocol version", own.version, 1)
    if not 0.0 < own.watchdog <= WATCHDOG:
        raise DiffersError(f"watchdog {1000 * own.watchdog:.0f} ms, not above 0 and at most 80")
    lower = round(own.pressure_limit / 2.0, 2)
    equal("a lower limit", host.hello(lower).pressure_limit, lower)
    equal("a limit of 655.34", host.hello(655.34).pressure_limit, own.pressure_limit)
    equal("the device's own limit", host.hello().pressure_limit, own.pressure_limit)
    reading = host.reading()
    _shows(reading, "after hello", Mode.READY)
    equal("flow is known", not math.isnan(reading.flow), Capability.FLOW in own.capabilities)


def _version(host: Probe) -> None:
    before = host.counters()
    other = host.random.getrandbits(32)
    for session in (host.session, other):
        host.refused(Hello(2), Reason.VERSION, session=session)
    host.refused(Hello(2), Reason.VERSION, step=0)
    after = host.counters()  # with the next number: the refused one was not consumed
    equal("messages of another number", after.sequence, before.sequence)


def _sessions(host: Probe) -> None:
    other = host.random.getrandbits(32)
    with host.counting(session=5):
        for message in (Arm(), Command(1.0, 0, 0), Heartbeat(), Statistics()):
            host.refused(message, Reason.SESSION, session=other)
        host.refused(Command(200.0, 0, 0), Reason.SESSION, session=other)
    _shows(host.reading(), "after strangers", Mode.READY)
    old = host.session
    host.inspire()
    host.hello()
    _shows(host.reading(), "after a second host", Mode.READY)
    host.refused(Heartbeat(), Reason.SESSION, session=old)


def _again(host: Probe) -> None:
    host.reading()
    for step in (0, -1):
        host.refused(Hello(), Reason.SEQUENCE, step=step)
    host.ask(Hello(pressure_limit=20.0), Welcome)
    _shows(host.reading(), "after a hello of the same session", Mode.READY)


def _numbers(host: Probe) -> None:
    with host.counting(sequence=12):
        for step in (0, -1, WINDOW + 1):
            for message in (Heartbeat(), Arm(), Statistics(), Command(200.0, 0, 0)):
                host.refused(message, Reason.SEQUENCE, step=step)
    host.ask(Heartbeat(), Reading, step=WINDOW)
    host.ask(Heartbeat(), Reading, step=2)


def _consumed(host: Probe) -> None:
    host.refused(Command(1.0, 0, 0), Reason.NOT_ARMED)
    host.refused(Heartbeat(), Reason.SEQUENCE, step=0)
    host.refused(Command(200.0, 0, 0), Reason.OUT_OF_RANGE)
    host.refused(Heartbeat(), Reason.SEQUENCE, step=0)
    host.ask(Vent(), Reading)
    host.refused(Heartbeat(), Reason.SEQUENCE, step=0)
    host.ask(Vent(), Reading, step=-1)
    host.ask(Vent(), Reading, step=WINDOW + 1)
    host.ask(Vent(), Reading, step=5, session=host.session ^ 1)
    host.reading()


# Commands.


def _not_armed(host: Probe) -> None:
    with host.counting(not_armed=2):
        host.refused(host.command(10.0, 0), Reason.NOT_ARMED)
        host.refused(host.command(10.0, 0, age=5000), Reason.NOT_ARMED)
    _shows(host.reading(), "after a command before arming", Mode.READY)


def _commands(host: Probe) -> None:
    with host.counting(commands=4):
        host.arm()
        for u_in, u_out in ((12.34, 0), (0.01, 1), (100.0, 1), (0.0, 0)):
            reading = host.ask(host.command(u_in, u_out), Reading)
            _shows(reading, "after a command", Mode.RUNNING, u_in, u_out)
            _shows(host.reading(), "after a heartbeat", Mode.RUNNING, u_in, u_out)


def _out_of_range(host: Probe) -> None:
    with host.counting(out_of_range=8):
        for armed in (True, False):
            for u_in, u_out in ((100.01, 0), (655.35, 1), (5.0, 2), (5.0, 255)):
                host.hello()
                if armed:
                    host.arm()
                command = host.command(u_in, u_out, age=0 if armed else 9999)
                refusal = host.refused(command, Reason.OUT_OF_RANGE)
                for seen in (refusal, host.reading()):
                    _vented(seen, "after a command out of range", Flag.OUT_OF_RANGE)
                host.refused(host.command(5.0, 0), Reason.NOT_ARMED)


def _stale(host: Probe) -> None:
    with host.counting(stale=4):
        host.arm()
        for age in (101, 5000, 1 << 31, -10_000):
            host.refused(host.command(50.0, 0, age), Reason.STALE)
        _shows(host.reading(), "after stale commands", Mode.RUNNING)
        asked = host.clock.now()
        fresh = host.command(50.0, 0, age=50)
        got = host.raw(host.frame(fresh)).message
        host.sequence, host.fed = host.sequence + 1, asked
        if host.clock.now() - asked > 0.030:
            raise LateError
        equal("a command on a reading of 50 ms", told(got), "reading")


# Guards.


def _vent(host: Probe) -> None:
    for session, step in ((None, 1), (host.session ^ 0x5A5A5A5A, 1), (None, 0)):
        host.inspire()
        reading = host.ask(Vent(), Reading, step=step, session=session)
        _vented(reading, "after a vent", Flag.HOST_VENTED)
        host.refused(host.command(30.0, 0), Reason.NOT_ARMED)
    host.arm()
    equal("flags after arming", host.ask(Arm(), Reading).flags & ~Flag.SATURATED, Flag.NONE)


def _rearm(host: Probe) -> None:
    host.inspire()
    _shows(host.ask(Arm(), Reading), "after arming again", Mode.RUNNING)


def _pressure(host: Probe) -> None:
    host.hello(0.0)
    pressure = host.reading().pressure
    if not pressure > 0.5:
        raise UntriedError(f"the sensor shows {pressure:g} cmH2O; it needs more than 0.5")
    refusal = host.refused(Arm(), Reason.UNSAFE)
    _vented(refusal, "with the pressure above the limit")
    equal("over pressure is flagged", Flag.OVERPRESSURE in refusal.flags, True)
    host.refused(host.command(1.0, 1), Reason.NOT_ARMED)
    host.hello(round(pressure + 5.0, 2))
    host.arm()


def _watchdog(
    host: Probe,
    begin: Callable[[Probe], object] = Probe.inspire,
    feed: Callable[[Probe], object] = lambda host: None,
) -> None:
    """The device vents between the watchdog's time and its bound after the last command."""
    before = host.counters().watchdog
    begin(host)
    first, host.fed = host.fed, math.inf  # it vents on purpose
    last = host.clock.now()  # the device took it before
    lived = False
    while True:
        asked = host.clock.now()
        feed(host)
        reading = host.reading()
        if reading.mode is Mode.RUNNING:
            if asked > last + BOUND:
                raise DiffersError(f"it still ran {1000 * (asked - last):.0f} ms after the last")
            lived = True
        elif host.clock.now() - first < host.watchdog - ANSWER:
            raise DiffersError(
                f"it vented {1000 * (host.clock.now() - first):.0f} ms after the last"
            )
        else:
            break
        host.clock.sleep_until(asked + 0.004)
    if not lived or Flag.DEVICE_LATE in reading.flags:
        raise LateError
    _vented(reading, "after silence", Flag.COMMANDS_STOPPED)
    equal("counter watchdog", host.counters().watchdog - before, 1)
    host.refused(host.command(30.0, 0), Reason.NOT_ARMED)


def _feeds(host: Probe) -> None:
    host.arm()
    for k in range(8):
        host.clock.sleep_until(host.fed + 0.045)
        reading = host.ask(host.command(20.0 + k, k % 2), Reading)
        equal("mode under commands 45 ms apart", reading.mode.name, "RUNNING")


def _restless(host: Probe) -> None:
    """Messages that must not feed the watchdog; the device may vent in between."""
    try:
        host.refused(host.command(30.0, 0, age=500), Reason.STALE)
        host.refused(Command(30.0, 0, 0), Reason.SEQUENCE, step=0)
        host.refused(Arm(), Reason.SESSION, session=host.session ^ 1)
        host.counters()
    except DiffersError:
        if host.reading().mode is Mode.RUNNING:
            raise


def _answers(host: Probe) -> None:
    trips = []
    for _ in range(50):
        begun = host.clock.now()
        host.reading()
        trips.append(host.clock.now() - begun)
    median = sorted(trips)[len(trips) // 2]
    wire = (len(host.frame(Heartbeat())) + 39) * 10 / 115_200  # of the slowest line
    if median > ANSWER + wire:
        raise DiffersError(f"half of the answers took longer than {1000 * median:.1f} ms")


def _time(host: Probe) -> None:
    before, first = host.reading().time, host.clock.now()
    host.clock.sleep_until(first + 0.2)
    passed = host.reading().time - before
    slack = host.clock.now() - first
    if not 0.1 * slack <= passed <= slack + 0.05:  # how right it must be is not specified
        raise DiffersError(f"its clock went {1000 * passed:.0f} ms in {1000 * slack:.0f} ms")


#: What the specification asks, and how it is tried.
CLAUSES: tuple[tuple[str, Callable[[Probe], None]], ...] = (
    ("garbage before a frame costs no frame (frames)", _garbage),
    ("frames in pieces, and with one zero between, are read (frames)", _pieces),
    ("bad COBS, too long, wrong CRC: counted, not answered (frames)", _faulty),
    ("unknown kind, wrong length, a device's kind: malformed (order 1)", _malformed),
    ("the device sends nothing by itself (messages)", _silent),
    ("welcome: version, watchdog, limits, and no limit is raised (duty 5)", _welcome),
    ("another protocol version is refused first, and consumes nothing (order 3)", _version),
    ("other sessions are refused before all else; a new hello vents (order 4)", _sessions),
    ("a hello of the open session needs a new number (duty 4)", _again),
    ("numbers rise by 1 to 65,536; others are refused before all else (duty 4)", _numbers),
    ("refused for what it asks, a message has consumed its number (order 5)", _consumed),
    ("commands before arming are refused, fresh or stale (order 7)", _not_armed),
    ("commands move the valves, heartbeats do not (messages)", _commands),
    ("a command out of range vents, armed or not, fresh or not (order 6)", _out_of_range),
    ("a command on a reading older than 100 ms, or to come, is refused (order 8)", _stale),
    ("a vent is obeyed in every session, with every number (order 2)", _vent),
    ("arming again closes the inspiratory valve (messages)", _rearm),
    ("pressure above the session's limit bars arming (duty 2)", _pressure),
    ("vented in time after the last command (duty 2)", _watchdog),
    ("vented in time after arming (duty 2)", lambda host: _watchdog(host, Probe.arm)),
    (
        "refused messages do not feed the watchdog (duty 2)",
        lambda host: _watchdog(host, feed=_restless),
    ),
    ("commands feed the watchdog (duty 2)", _feeds),
    ("readings carry the device's time (messages)", _time),
    ("answers come within 5 ms (duty 6)", _answers),
)


@dataclass(frozen=True, slots=True)
class Clause:
    """One line of the verdict."""

    text: str  #: what the specification asks, and where.
    holds: bool | None  #: whether it does; None if it was not tried.
    detail: str = ""  #: what was seen instead, or why it was not tried.

    def __str__(self) -> str:
        """A line for people."""
        mark = {True: "holds", False: "FAILS", None: "not tried"}[self.holds]
        return f"{mark:9}  {self.text}{f': {self.detail}' if self.detail else ''}"


def conformance(
    transport: Transport, clock: Clock, tell: Callable[[Clause], None] = lambda clause: None
) -> list[Clause]:
    """Try a device by the specification, by the clock of its transport.

    Returns all lines, in the order of :data:`CLAUSES`, then those of :data:`NOT_TRIED`; ``tell`` is
    called with each as it is known.

    Raises:
        NoAnswerError: if there is no device.
        DisconnectedError: if the port goes away.
    """
    host, done = Probe(transport, clock), []
    for attempt in range(_ATTEMPTS):
        try:
            host.hello()
            break
        except DiffersError as error:
            if attempt == _ATTEMPTS - 1:
                raise NoAnswerError(f"the device does not answer a hello: {error}") from None
    untried = (Clause(text, None, "no host can provoke it") for text in NOT_TRIED)
    for clause in chain((_judged(host, text, check) for text, check in CLAUSES), untried):
        done.append(clause)
        tell(clause)
    host.transport.write(host.frame(Vent()))
    return done


def _judged(host: Probe, text: str, check: Callable[[Probe], None]) -> Clause:
    reason = ""
    for _ in range(_ATTEMPTS):
        before = None
        try:
            before = _anew(host)
            host.hello()
            check(host)
        except LateError:
            reason = "the host was too slow; close other programs"
            host.hear(0.25)
            continue
        except DiffersError as error:
            reason = str(error)
            if before is None or _by_itself(host, before):
                continue
            return Clause(text, False, reason)
        except UntriedError as error:
            return Clause(text, None, str(error))
        return Clause(text, True)
    return Clause(text, False, f"{reason}, {_ATTEMPTS} times in a row")


def _anew(host: Probe) -> Counters:
    """Leave what was before, and open a session; the device's counters."""
    host.hear(0.01)
    host.heard.clear()
    host.fed = math.inf
    host.hello()
    return host.counters()


def _by_itself(host: Probe, before: Counters) -> bool:
    """Whether sensor, pressure or lateness have made the device vent since."""
    try:
        after = _anew(host)
    except DiffersError:
        return False
    names = ("sensor", "overpressure", "device_late")
    return any(getattr(after, name) != getattr(before, name) for name in names)
