"""One run on a bench: three breaths in real time, each step safe, everything noted.

The loop runs at the protocol's 30 ms by absolute deadlines, so that a late step does not shift
those after it. Each step takes a fresh reading, looks at it (:mod:`hardware_eval.bench.safety`),
asks the controller, and sends the command. A controller that has not answered in time does not hold
the loop up: the fallback takes over (:mod:`hardware_eval.bench.fallback`), or without one the last
safe command is repeated, and it is counted. However a run ends, its last act is to
vent the lung; where it can act no more (``kill -9``, a cable pulled, a machine asleep) the device's
watchdog does.
"""

from __future__ import annotations

import contextlib
import gc
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from msgspec import structs

from hardware_eval import realtime
from hardware_eval.bench import fallback, safety
from hardware_eval.bench.controllers import (
    NONE,
    ControllerFailedError,
    Count,
    Lateness,
    LiveController,
)
from hardware_eval.bench.plan import MEASURED, PERTURBED_BREATH, PERTURBED_STEP, LogLine, PlannedRun
from hardware_eval.bench.safety import SafetySample, SafetySettings, Trip
from hardware_eval.realtime import Clock
from hardware_eval.wire.client import Client, LinkError, NoAnswerError, RefusedError
from hardware_eval.wire.messages import CAUSES, Flag, Reading, Reason
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.task import protocol, waveform
from ventbench.task.lungs import lung as parse_lung
from ventbench.task.metrics import measured

#: When a controller must have answered, s after the step's deadline: what is left of 30 ms is for
#: the command's way to the device, and for this loop.
ANSWER_BY = 0.022

#: Share of a run's answers that may come later than that, or that the fallback may refuse; an entry
#: of more fails.
LATE_SHARE = 0.01

#: A late answer counts only if it had this time at least, s: else the host was late, not the entry.
_FAIR = 0.5 * ANSWER_BY

#: What is left of a step when the wait for the command's answer ends, s: the next step must not be
#: late. An answer that comes later is missed, and the next reading tells what the device does.
RESERVE = 0.002

#: Rest at PEEP before a run, s: several time constants of the slowest lung (1.25 s).
REST_S = 4.0

#: A step counts as on time if it begins within this of its deadline, s.
ON_TIME_S = 0.002

#: The bias flow of the expiration, which a controller is told at the start of a breath, %.
_BIAS = float(waveform.expiratory_command(protocol.BREATH_STEPS - 1))


class Operator:
    """The person at the bench; this one confirms everything, for dry runs and tests."""

    def confirm(self, question: str) -> bool:
        """Ask; False ends the session."""
        return True

    def number(self, question: str) -> float:
        """Ask for a number that a person reads or knows; InputError where there is none."""
        raise InputError(f"{question}nobody is there to answer")

    def tell(self, text: str) -> None:
        """Say something."""

    def stop(self) -> bool:
        """Whether the emergency stop has been pressed; called at every step."""
        return False

    def disturb(self, perturbation: str, on: bool) -> None:
        """Open a leak or pinch the tube now, or undo it."""


class BreathLog(msgspec.Struct, frozen=True):
    """One breath as it happened; lists of one value a step.

    Attributes:
        time: of the reading, s since the run began.
        pressure, flow: readings, cmH2O and mL/s; NaN where there was none.
        requested: what the controller asked for, %; NaN where it did not answer in time.
        u_in, u_out: what was commanded, %, 0/1.
        target: cmH2O.
        late: how late the step began, s.
        busy: time from the step's beginning to the command's answer, s.
    """

    time: list[float] = []
    pressure: list[float] = []
    flow: list[float] = []
    requested: list[float] = []
    u_in: list[float] = []
    u_out: list[int] = []
    target: list[float] = []
    late: list[float] = []
    busy: list[float] = []

    def line(self, run: PlannedRun, attempt: int, breath: int) -> LogLine:
        """The breath as a line of the log; the pressure after the last command is none of it."""
        steps = len(self.u_in)
        rounded = {
            name: [None if math.isnan(value) else round(value, 6) for value in each[:steps]]
            for name, each in structs.asdict(self).items()
            if name not in ("target", "u_out")
        }
        return run.line("breath", attempt, breath=breath, **rounded, u_out=[*self.u_out])

    @classmethod
    def of_line(cls, line: LogLine) -> BreathLog:
        """The breath that a line of the log holds."""
        columns: dict[str, Any] = {
            name: [math.nan if value is None else value for value in line[name]]
            for name in cls.__struct_fields__
            if name != "target"
        }
        steps = np.arange(len(columns["time"]))
        return cls(**columns, target=waveform.target(steps, line["pip"]).tolist())


#: Told the place and the content of each breath of a run once it ends.
OnBreath = Callable[[int, BreathLog], None]

#: Shows a breath of a run while the lung breathes out; told how many runs of the plan are done, and
#: how many there are.
Show = Callable[[PlannedRun, BreathLog, int, int], None]


class EmergencyStop(Exception):
    """The operator pressed the stop key."""


@dataclass(frozen=True)
class Bench:
    """What a session works with."""

    client: Client  #: of the device.
    clock: Clock  #: of the device's time or a virtual one.
    settings: SafetySettings  #: safety.
    operator: Operator  #: the person.
    shows: Sequence[Show] = ()  #: what shows breaths.
    rest: float = REST_S  #: time at rest before each run, s.
    fallback: bool = False  #: whether a safe controller takes over.
    lateness: Lateness = field(default_factory=Lateness)  #: late answers, to tell whose they are.


@dataclass(frozen=True)
class Ended:
    """Why valves are driven no longer; the lung is vented."""

    reasons: tuple[str, ...] = ()  #: messages of the checks, of the device or the controller.
    #: ``"complete"``; ``"failed"`` if the controller is to blame; ``"aborted"`` if the bench is, so
    #: that its run is repeated.
    status: str = "aborted"
    held_up: bool = False  #: whether host or line, too slow for the loop, ended it alone.
    #: time from the sample that tripped until the device had vented, s; NaN if nothing tripped.
    vented_after: float = math.nan

    @property
    def reason(self) -> str:
        """The first reason; empty if there is none."""
        return next(iter(self.reasons), "")


@dataclass(frozen=True)
class RunResult(Ended):
    """What became of one run.

    Attributes:
        trips: safety checks that tripped.
        breaths: those that began.
        late_answers: steps whose controller did not answer in time, though the host asked in time.
        limited: commands that a limit of the bench cut.
        asked: steps whose controller was asked.
        longest_answer: longest time that an answer took, s.
        outside: answers that the fallback refused.
        fallback, longest_fallback: steps that it commanded, in all and in a row.
        beside: answers of an empty controller beside the entry.
    """

    trips: tuple[Trip, ...] = ()
    breaths: tuple[BreathLog, ...] = ()
    late_answers: int = 0
    limited: int = 0
    asked: int = 0
    longest_answer: float = 0.0
    outside: int = 0
    fallback: int = 0
    longest_fallback: int = 0
    beside: Count = NONE

    @property
    def error(self) -> float:
        """Mean |pressure - PIP| over the scored inspirations, cmH2O; NaN unless complete."""
        if self.status != "complete":
            return math.nan
        pressure, target = (
            measured.scored([getattr(breath, name) for breath in self.breaths])
            for name in ("pressure", "target")
        )
        return measured.mean_error(pressure, target)


class Watched:
    """Valves that are driven step by step, until a check trips and vents the lung.

    Args:
        bench: device, clock, safety, operator.
        lung: label, for the checks.
        pip: highest pressure that is meant, cmH2O, for the checks.

    Attributes:
        pip: see there; may be changed between two breaths.
        log: what happened since :meth:`begin`.
        answered: whether the device answered, of each reading.
        last: command in force.
        ended: why it ended; None as it goes on.
        missed: answers that did not come in time.
    """

    def __init__(self, bench: Bench, lung: str, pip: float) -> None:
        self._bench, self._lung, self.pip = bench, parse_lung(lung), pip

    @property
    def trips(self) -> tuple[str, ...]:
        """Why it ended; empty as it goes on."""
        return self.ended.reasons if self.ended else ()

    def begin(self) -> None:
        """Vent, rest, and arm the device."""
        client, clock = self._bench.client, self._bench.clock
        self.log, self.answered, self.last = BreathLog(), list[bool](), (0.0, 1)
        self.ended: Ended | None = None
        self.missed = 0
        self._safety = safety.SafetyState(self._lung)
        client.vent()
        clock.sleep_until(clock.now() + self._bench.rest)
        self._start = self._deadline = clock.now() + protocol.DT
        try:
            client.arm()
        except RefusedError as error:
            self._end(Ended((f"the device cannot be armed: {error}",)))

    def look(self, target: float) -> Reading | None:
        """The reading at the deadline of the next step, seen by the checks; None if there is none.

        Args:
            target: for the log, cmH2O.

        Raises:
            EmergencyStop: if the operator pressed the key; the lung is vented.
            LinkError: if the device is lost.
        """
        bench, log = self._bench, self.log
        bench.clock.sleep_until(self._deadline)
        self._began = began = bench.clock.now()
        if bench.operator.stop():
            self.vent()
            raise EmergencyStop
        reading = None
        try:
            reading = None if self.ended else bench.client.heartbeat()
        except NoAnswerError:
            self.missed += 1
        except RefusedError as error:
            self._refused(error)
        if self.ended:
            return None
        late = max(began - self._deadline, 0.0)
        pressure, flow, applied = (math.nan,) * 3
        if reading is not None:
            pressure, flow, applied = reading.pressure, reading.flow, reading.u_in
        answered = reading is not None
        sample = SafetySample(began, pressure, flow, *self.last, self.pip, late, applied, answered)
        log.time.append(began - self._start)
        log.pressure.append(pressure)
        log.flow.append(flow)
        log.target.append(target)
        log.late.append(late)
        self.answered.append(answered)
        if reading is not None and reading.flags & _CAUSES:
            self._vented_by_device(reading.flags)
            return None
        self._safety = safety.step(bench.settings, self._safety, sample)
        if trips := self._safety.trips:
            self.vent()
            checks = [safety.CHECKS[trip.check] for trip in trips]
            status = "aborted" if all(check.bench for check in checks) else "failed"
            held_up = all(check.timing for check in checks)
            messages = tuple(trip.message for trip in trips)
            self.ended = Ended(messages, status, held_up, bench.clock.now() - began)
        return reading

    def send(self, u_in: float, u_out: int, requested: float) -> None:
        """Hold a command, % and 0/1, until the next step's deadline; note what was asked for, %."""
        bench, log, deadline = self._bench, self.log, self._deadline
        self._deadline += protocol.DT
        if self.ended:
            return
        try:
            left = deadline + protocol.DT - RESERVE - bench.clock.now()
            bench.client.command(u_in, u_out, max(left, 0.0))
        except RefusedError as error:
            self._refused(error)
            return
        except NoAnswerError:  # it may have arrived; the next reading and the watchdog tell
            self.missed += 1
        self.last = (u_in, u_out)
        log.requested.append(requested)
        log.u_in.append(u_in)
        log.u_out.append(u_out)
        log.busy.append(bench.clock.now() - self._began)

    def send_limited(self, wanted: float, u_out: int) -> None:
        """Hold a command, % and 0/1, cut to what is safe."""
        u_in, _ = safety.limit_command(self._bench.settings, self.last[0], wanted)
        self.send(u_in, u_out, wanted)

    def vent(self) -> None:
        """Vent the lung."""
        with contextlib.suppress(LinkError):  # then the watchdog does
            self._bench.client.vent()

    def _end(self, ended: Ended) -> None:
        self.vent()
        self.ended = ended

    def _refused(self, error: RefusedError) -> None:
        if error.refusal.flags & _CAUSES:
            self._vented_by_device(error.refusal.flags)
            return
        lost = error.refusal.reason is Reason.SESSION  # arming opens it again
        self._end(Ended((str(error),), held_up=lost))

    def _vented_by_device(self, flags: Flag) -> None:
        # The device's pressure limit is the controller's to respect; all else is the bench's.
        status = "failed" if flags & Flag.OVERPRESSURE else "aborted"
        held_up = bool(flags & _HELD_UP) and not flags & _CAUSES & ~_HELD_UP
        message = f"the device vented: {(flags & _CAUSES).name}"
        self._end(Ended((message,), status, held_up, 0.0))


def run_once(
    bench: Bench,
    run: PlannedRun,
    controller: LiveController,
    *,
    on_breath: OnBreath = lambda index, breath: None,
) -> RunResult:
    """Run three breaths; the lung is vented before and after, whatever happens.

    Args:
        bench: device, clock, operator.
        run: what runs.
        controller: fresh.
        on_breath: called with the place and the content of each breath once it ends, also of one
            that was cut short.

    Raises:
        LinkError: if the port goes away or the device is silent; it vents by itself.
        EmergencyStop: if the operator pressed the key; the lung is vented.
    """
    return _Loop(bench, run, controller).run(on_breath)


class _Loop(Watched):
    """The state of one run."""

    def __init__(self, bench: Bench, run: PlannedRun, controller: LiveController) -> None:
        super().__init__(bench, run.lung, run.pip)
        self._run, self._controller = run, controller
        self._fallback = fallback.FallbackState(self._lung)
        self._breaths: list[BreathLog] = []
        self._asked = self._late_answers = self._limited = 0
        self._disturbed = False

    def run(self, on_breath: OnBreath) -> RunResult:
        """All breaths; see :func:`run_once`."""
        try:
            with undisturbed():
                self.begin()
                for breath in range(protocol.BREATHS):
                    if self.ended:
                        break
                    self.log = BreathLog()
                    self._breaths.append(self.log)
                    for step in range(protocol.BREATH_STEPS):
                        self._step(breath, step)
                        if self.ended:
                            break
                    on_breath(breath, self.log)
        finally:
            self.vent()
        ended = self.ended or self._measured()
        if self._disturbed:
            self._bench.operator.disturb(self._run.perturbation, False)
        return RunResult(
            ended.reasons,
            ended.status,
            ended.held_up,
            ended.vented_after,
            self._safety.trips,
            tuple(self._breaths),
            self._late_answers,
            self._limited,
            self._asked,
            self._controller.longest_answer,
            self._fallback.outside,
            self._fallback.taken,
            self._fallback.longest,
            self._controller.beside,
        )

    def _measured(self) -> Ended:
        """The end of a run that went through.

        A score needs the pressures of its inspirations, and a controller that answered in time.
        """
        outside, most = self._fallback.outside, max(LATE_SHARE * self._asked, 1.0)
        own, empty = Count(self._late_answers, self._asked), self._controller.beside
        of_host = self._bench.lateness.is_of_host(self._run.entry, own, empty)
        if own.late + outside > most:
            left = f", {outside} were outside the envelope" if outside else ""
            of_host &= outside <= most
            beside = f"; of an empty controller beside it {empty}" if empty.asked else ""
            reason = (
                f"{own} answers took longer than {1e3 * ANSWER_BY:.0f} ms, the longest "
                f"{1e3 * self._controller.longest_answer:.0f} ms{beside}{left}; "
                f"{100 * LATE_SHARE:g} % may"
            )
            return Ended((reason,), "aborted" if of_host else "failed", of_host)
        if self._run.kind in MEASURED:
            pressure = measured.scored([breath.pressure for breath in self._breaths])
            if reason := measured.too_few(pressure):
                missing = int(np.isnan(pressure).sum())
                return Ended((reason,), held_up=missing <= self.answered.count(False))
        return Ended((), "complete")

    def _step(self, breath: int, step: int) -> None:
        """One control step."""
        bench, run, log = self._bench, self._run, self.log
        if run.perturbation and (breath, step) == (PERTURBED_BREATH, PERTURBED_STEP):
            bench.clock.sleep_until(self._deadline)
            bench.operator.disturb(run.perturbation, True)
            self._disturbed = True
        last = bench.client.reading
        reading = self.look(float(waveform.target(step, run.pip)))
        # A controller must see each breath begin; what the last command's answer told is at most a
        # step old, at the end of an expiration.
        if not self.ended:
            if math.isnan(shown(reading)) and step == 0 and last is not None:
                reading = last
                log.pressure[-1], log.flow[-1] = last.pressure, last.flow
            self._act(reading, step)
        if len(log.u_in) < len(log.time):  # so that every list of the breath has as many values
            log.requested.append(math.nan)
            log.u_in.append(0.0)
            log.u_out.append(1)
            log.busy.append(bench.clock.now() - self._began)

    def _act(self, reading: Reading | None, step: int) -> None:
        """Choose a command and send it."""
        bench, run = self._bench, self._run
        if step >= protocol.INSPIRATION_STEPS:
            self.send(float(waveform.expiratory_command(step)), 1, math.nan)
            return
        requested, budget, cut = math.nan, 0.0, False
        u_in: float | None = None
        previous = _BIAS if step == 0 else self.last[0]
        # A reading without a number would poison the averages of the entry that sees it.
        if math.isfinite(pressure := shown(reading)):
            row = _row(step, pressure, self.log.target[-1], run.pip, previous)
            budget = self._deadline + ANSWER_BY - bench.clock.now()
            self._asked += 1
            try:
                answer = self._controller.act(row, budget)
            except ControllerFailedError as error:
                self._end(Ended((str(error),), "failed"))
                return
            requested = math.nan if answer is None else answer
        self._late_answers += math.isnan(requested) and budget >= _FAIR
        if not math.isnan(requested):
            u_in, cut = safety.limit_command(bench.settings, previous, requested)
        if bench.fallback:
            self._fallback, u_in = fallback.step(
                self._fallback, step, pressure, run.pip, u_in, previous
            )
            u_in, also = safety.limit_command(bench.settings, previous, u_in)
            cut |= also
        elif u_in is None:
            u_in = self.last[0] if self.last[1] == 0 else 0.0
        self._limited += cut
        self.send(u_in, 0, requested)


_CAUSES = CAUSES & ~Flag.HOST_VENTED


_HELD_UP = Flag.COMMANDS_STOPPED | Flag.DEVICE_LATE


def shown(reading: Reading | None) -> float:
    """Pressure of a reading, cmH2O; NaN if there is none."""
    return math.nan if reading is None else reading.pressure


def _row(step: int, pressure: float, target: float, pip: float, previous: float) -> Floats:
    """The observation of a step, ``(1, ROW)``."""
    ahead = waveform.targets_ahead(step, pip)
    head = [step * protocol.DT, protocol.DT, pressure, target]
    return np.array([[*head, *ahead.tolist(), previous]])


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Run before ordinary work; collect garbage now and not for a while.

    A collection takes longer than a step may, and than the watchdog waits.
    """
    was = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        with realtime.priority():
            yield
    finally:
        if was:
            gc.enable()
