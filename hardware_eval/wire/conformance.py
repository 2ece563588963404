"""Does a device follow PROTOCOL.md? The specification as a list of checks over the wire.

Written from the specification, with nothing of a device but the codec of the wire. Every check
begins a session of its own. What a slow host could spoil is judged by bounds that lateness cannot
move, and is otherwise tried again: an answer that came before the watchdog's time shows that the
device had no reason to vent, and a question that was asked after its bound that it must have. So is
a check in which sensor or pressure made the device vent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

from hardware_eval.realtime import Clock
from hardware_eval.wire.clauses import CLAUSES
from hardware_eval.wire.client import Transport
from hardware_eval.wire.messages import Counters, Vent
from hardware_eval.wire.parser import NoAnswerError
from hardware_eval.wire.probe import DiffersError, LateError, Probe, UntriedError

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
    transport: Transport, clock: Clock, tell: Callable[[Clause], None] = lambda clause: None,
    seed: int = 0,
) -> list[Clause]:  # fmt: skip
    """Try a device by the specification, by the clock of its transport.

    Returns all lines, in the order of :data:`CLAUSES`, then those of :data:`NOT_TRIED`; ``tell`` is
    called with each as it is known. ``seed`` is that of the session numbers.

    Raises:
        NoAnswerError: if there is no device.
        DisconnectedError: if the port goes away.
    """
    host, done = Probe(transport, clock, seed), []
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
            host.hear(0.01)
            host.heard.clear()
            host.hello()
            before = host.counters()
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


def _by_itself(host: Probe, before: Counters) -> bool:
    """Whether sensor, pressure or lateness have made the device vent since."""
    try:
        host.hear(0.01)
        host.heard.clear()
        host.hello()
        after = host.counters()
    except DiffersError:
        return False
    names = ("sensor", "overpressure", "device_late")
    return any(getattr(after, name) != getattr(before, name) for name in names)
