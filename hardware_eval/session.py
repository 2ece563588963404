"""A session at the bench: a plan's runs in real time, each step safe, everything written down.

The loop runs at the protocol's 30 ms by absolute deadlines, so that a late step does not shift
those after it. Each step takes a fresh reading, looks at it (:mod:`hardware_eval.safety`), asks the
controller, and sends the command. A controller that has not answered in time does not hold the loop
up: the last safe command is repeated, and counted. However a session ends, its last act is to vent
the lung; where it can act no more (``kill -9``, a cable pulled, a machine asleep) the device's
watchdog does.
"""

from __future__ import annotations

import contextlib
import gc
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hardware_eval import safety
from hardware_eval.client import Client
from hardware_eval.clock import Clock
from hardware_eval.errors import LinkError, NoAnswerError, RefusedError
from hardware_eval.messages import Flag, Reading
from hardware_eval.plan import (
    CONTROL,
    CONTROL_GAINS,
    PERTURBED_BREATH,
    PERTURBED_STEP,
    Plan,
    PlannedRun,
    progress,
)
from hardware_eval.raw_log import RawLog, lines
from hardware_eval.realtime import has_priority, take_priority
from hardware_eval.safety import SafetySample, SafetySettings, Trip
from ventbench import protocol, waveform
from ventbench.interfaces import Task
from ventbench.lungs import lung as parse_lung

Floats = NDArray[np.float64]

#: When a controller must have answered, s after the step's deadline: what is left of 30 ms is for
#: the command's way to the device, and for this loop.
ANSWER_BY = 0.022

#: Rest at PEEP before a run, s: several time constants of the slowest lung (1.25 s).
REST_S = 4.0

#: Runs that the bench spoils in a row before the session gives up.
MAX_ATTEMPTS = 3

#: The bias flow of the expiration, which a controller is told at the start of a breath, %.
_BIAS = float(waveform.expiratory_command(protocol.BREATH_STEPS - 1))


class ControllerFailedError(Exception):
    """A controller raised, returned no number, or did not answer for seconds."""


class LiveController(Protocol):
    """A controller that answers in time or not at all."""

    def act(self, row: Floats, budget: float) -> float | None:
        """Ask for the next command.

        Args:
            row: the observation, as :func:`ventbench.submissions.runner.pack` lays it out.
            budget: time for the answer, s.

        Returns:
            ``u_in``, %; None if there is no answer yet.

        Raises:
            ControllerFailedError: if there will be none.
        """
        ...

    def close(self) -> None:
        """End it."""
        ...


#: Makes the controller of a run.
MakeController = Callable[[PlannedRun], LiveController]


class SubmissionController:
    """A submission in its process, asked by a thread so that the loop need not wait for it.

    Args:
        runner: as in scoring; see :class:`ventbench.submissions.runner.Runner`.
        submission: whose code runs.
        task: what the controller is told.
        real_time: whether ``budget`` holds; else answers are waited for.
    """

    def __init__(self, runner: Any, submission: Any, task: Task, *, real_time: bool = True) -> None:
        self._session = runner.start(submission, [task])
        self._real_time = real_time
        self._label = submission.manifest.name
        begin = take_priority if has_priority() else None  # a thread that waits for a pipe
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="controller", initializer=begin)
        self._pending: Future[Floats] | None = None
        self._check()

    def act(self, row: Floats, budget: float) -> float | None:
        """Ask for the next command; an answer to an earlier observation is dropped."""
        began = time.perf_counter()
        if self._pending is not None:
            if self._result(self._pending, budget) is None:
                return None
            budget -= time.perf_counter() - began
        self._pending = self._thread.submit(self._session.act, row)
        answer = self._result(self._pending, budget)
        return None if answer is None else float(answer[0])

    def _result(self, pending: Future[Floats], budget: float) -> Floats | None:
        try:
            answer = pending.result(max(budget, 0.0) if self._real_time else None)
        except NotYet:
            return None
        self._pending = None
        self._check()
        return answer

    def _check(self) -> None:
        for failure in self._session.failures.values():
            raise ControllerFailedError(failure.message(self._label, None))

    def close(self) -> None:
        """End the process; an answer that never comes is not waited for."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self._session.close()


class PIDController:
    """The PID of the protocol in this process: control runs, exploring and self-tests.

    Args:
        gains: P, I and D, %/cmH2O.
        added: what is added to its command at a time of the breath, %; nothing if not given.
    """

    def __init__(
        self,
        gains: tuple[float, float, float],
        added: Callable[[int, float], float] | None = None,
    ) -> None:
        self._gains, self._added = gains, added or (lambda breath, time: 0.0)
        self._error = self._integral = self._derivative = 0.0
        self._breath = -1

    def act(self, row: Floats, budget: float) -> float | None:
        """Next command; the averages restart at each breath."""
        now, dt, pressure, target = (float(value) for value in row[0, :4])
        if now == 0.0:
            self._error = self._integral = self._derivative = 0.0
            self._breath += 1
        error, a = target - pressure, dt / (dt + 0.5)
        self._integral += a * (error - self._integral)
        self._derivative += a * (error - self._error - self._derivative)
        self._error = error
        P, I, D = self._gains  # noqa: E741 - the field's names
        u_in = P * error + I * self._integral + D * self._derivative
        return u_in + self._added(self._breath, now)

    def close(self) -> None:
        """Nothing to end."""


def control_pid(run: PlannedRun) -> PIDController:
    """The control between scored runs."""
    return PIDController((*CONTROL_GAINS[run.lung], 0.0))


class Operator(Protocol):
    """The person at the bench."""

    def confirm(self, question: str) -> bool:
        """Ask; False ends the session."""
        ...

    def tell(self, text: str) -> None:
        """Say something."""
        ...

    def stop(self) -> bool:
        """Whether the emergency stop has been pressed; called at every step."""
        ...

    def disturb(self, perturbation: str, on: bool) -> None:
        """Open a leak or pinch the tube now, or undo it."""
        ...


class View(Protocol):
    """Shows a session as it runs; called while the lung breathes out."""

    def breath(self, run: PlannedRun, breath: BreathLog, done: int, total: int) -> None:
        """Show a breath."""
        ...


@dataclass(frozen=True)
class BreathLog:
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

    time: list[float] = field(default_factory=list)
    pressure: list[float] = field(default_factory=list)
    flow: list[float] = field(default_factory=list)
    requested: list[float] = field(default_factory=list)
    u_in: list[float] = field(default_factory=list)
    u_out: list[int] = field(default_factory=list)
    target: list[float] = field(default_factory=list)
    late: list[float] = field(default_factory=list)
    busy: list[float] = field(default_factory=list)

    def line(self, run: PlannedRun, attempt: int, breath: int) -> dict[str, Any]:
        """The breath as a line of the log."""
        rounded = {
            name: [None if math.isnan(value) else round(value, 6) for value in getattr(self, name)]
            for name in vars(self)
            if name not in ("target", "u_out")
        }
        about = {"run": run.number, "attempt": attempt, "breath": breath, "entry": run.entry}
        label = {"kind": run.kind, "lung": run.lung, "pip": run.pip, "repeat": run.repeat}
        return {"type": "breath", **about, **label, **rounded, "u_out": list(self.u_out)}


@dataclass(frozen=True)
class RunResult:
    """What became of one run.

    Attributes:
        status: ``"complete"``; ``"failed"`` if its controller is to blame; ``"aborted"`` if the
            bench is, so that it runs again.
        reason: why it did not complete; empty if it did.
        trips: safety checks that tripped.
        breaths: those that began.
        late_answers: steps whose controller did not answer in time.
        limited: commands that a limit of the bench cut.
        vented_after: time from the sample that tripped until the device had vented, s; NaN if
            nothing tripped.
    """

    status: str
    reason: str
    trips: tuple[Trip, ...]
    breaths: tuple[BreathLog, ...]
    late_answers: int
    limited: int
    vented_after: float = math.nan

    @property
    def error(self) -> float:
        """Mean |pressure - PIP| over the scored inspirations, cmH2O; NaN unless complete."""
        if self.status != "complete":
            return math.nan
        errors = [
            abs(pressure - target)
            for k in protocol.SCORED_BREATHS
            for pressure, target in zip(
                self.breaths[k].pressure[: protocol.INSPIRATION_STEPS],
                self.breaths[k].target[: protocol.INSPIRATION_STEPS],
                strict=True,
            )
        ]
        return float(np.mean(errors))


class EmergencyStop(Exception):
    """The operator pressed the stop key."""


@dataclass(frozen=True)
class Bench:
    """What a session works with.

    Attributes:
        client: of the device.
        clock: of the device's time or a virtual one.
        settings: safety.
        operator: the person.
        view: shows breaths; None for none.
        rest: time at rest before each run, s.
    """

    client: Client
    clock: Clock
    settings: SafetySettings
    operator: Operator
    view: View | None = None
    rest: float = REST_S


def run_once(
    bench: Bench,
    run: PlannedRun,
    controller: LiveController,
    *,
    on_breath: Callable[[int, BreathLog], None] = lambda index, breath: None,
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
    loop = _Loop(bench, run, controller, on_breath)
    try:
        return loop.run()
    finally:
        with contextlib.suppress(LinkError):  # then the watchdog vents
            bench.client.vent()


class _Loop:
    """The state of one run."""

    def __init__(
        self,
        bench: Bench,
        run: PlannedRun,
        controller: LiveController,
        on_breath: Callable[[int, BreathLog], None],
    ) -> None:
        self._bench, self._run, self._controller = bench, run, controller
        self._on_breath = on_breath
        self._safety = safety.init(parse_lung(run.lung))
        self._breaths: list[BreathLog] = []
        self._late_answers = self._limited = 0
        self._command = (0.0, 1)
        self._disturbed = False

    def run(self) -> RunResult:
        """All breaths."""
        bench = self._bench
        bench.client.vent()
        bench.clock.sleep_until(bench.clock.now() + bench.rest)
        # Collected before the device waits for commands: that takes longer than the watchdog does.
        with no_collection():
            start = bench.clock.now() + protocol.DT
            try:
                bench.client.arm()
            except RefusedError as error:
                return self._ended("aborted", f"the device cannot be armed: {error}")
            for index in range(protocol.BREATHS * protocol.BREATH_STEPS):
                breath, step = divmod(index, protocol.BREATH_STEPS)
                deadline = start + index * protocol.DT
                bench.clock.sleep_until(deadline)
                if step == 0:
                    self._breaths.append(BreathLog())
                ended = self._step(start, deadline, breath, step)
                if ended is not None:
                    self._on_breath(breath, self._breaths[-1])
                    return ended
                if step == protocol.BREATH_STEPS - 1:
                    self._on_breath(breath, self._breaths[-1])
        return self._ended("complete", "")

    def _step(self, start: float, deadline: float, breath: int, step: int) -> RunResult | None:
        """One control step; a result ends the run."""
        bench, run, log = self._bench, self._run, self._breaths[-1]
        began = bench.clock.now()
        if bench.operator.stop():
            bench.client.vent()
            raise EmergencyStop
        self._disturb(breath, step)
        try:
            reading: Reading | None = bench.client.heartbeat()
        except NoAnswerError:
            reading = None
        except RefusedError as error:
            return self._ended("aborted", str(error))
        target = float(waveform.target(step, run.pip))
        log.time.append((bench.clock.now() if reading is None else began) - start)
        log.pressure.append(math.nan if reading is None else reading.pressure)
        log.flow.append(math.nan if reading is None else reading.flow)
        log.target.append(target)
        log.late.append(max(began - deadline, 0.0))
        result = self._look(reading, began, log.late[-1])
        if result is None:
            result = self._act(reading, deadline, step, target)
        if result is not None:  # so that every list of the breath has as many values
            log.requested.append(math.nan)
            log.u_in.append(0.0)
            log.u_out.append(1)
        log.busy.append(bench.clock.now() - began)
        return result

    def _look(self, reading: Reading | None, began: float, late: float) -> RunResult | None:
        """Let the checks see a reading; vent if one trips."""
        bench, run = self._bench, self._run
        if reading is not None and reading.flags & _CAUSES:
            return self._vented_by_device(reading.flags)
        sample = SafetySample(
            began,
            math.nan if reading is None else reading.pressure,
            math.nan if reading is None else reading.flow,
            self._command[0],
            self._command[1],
            run.pip,
            late,
            math.nan if reading is None else reading.u_in,
        )
        self._safety = safety.step(bench.settings, self._safety, sample)
        if not self._safety.trips:
            return None
        bench.client.vent()
        first = self._safety.trips[0]
        status = "aborted" if all(trip.bench for trip in self._safety.trips) else "failed"
        return self._ended(status, first.message, bench.clock.now() - began)

    def _vented_by_device(self, flags: Flag) -> RunResult:
        # The device's pressure limit is the controller's to respect; all else is the bench's.
        status = "failed" if flags & Flag.OVERPRESSURE else "aborted"
        return self._ended(status, f"the device vented: {(flags & _CAUSES).name}", 0.0)

    def _act(
        self, reading: Reading | None, deadline: float, step: int, target: float
    ) -> RunResult | None:
        """Choose a command and send it."""
        bench, run, log = self._bench, self._run, self._breaths[-1]
        inspiring = step < protocol.INSPIRATION_STEPS
        requested = math.nan
        if inspiring:
            previous = _BIAS if step == 0 else self._command[0]
            if reading is not None:
                row = _row(step, reading.pressure, target, run.pip, previous)
                budget = deadline + ANSWER_BY - bench.clock.now()
                try:
                    answer = self._controller.act(row, budget)
                except ControllerFailedError as error:
                    bench.client.vent()
                    return self._ended("failed", str(error))
                requested = math.nan if answer is None else answer
            if math.isnan(requested):
                self._late_answers += 1
                u_in = self._command[0] if self._command[1] == 0 else 0.0
            else:
                u_in, cut = safety.limit_command(bench.settings, previous, requested)
                self._limited += cut
            command = (u_in, 0)
        else:
            command = (float(waveform.expiratory_command(step)), 1)
        try:
            bench.client.command(*command)
        except RefusedError as error:
            return self._refused(error)
        except NoAnswerError:
            pass  # it may have arrived; the next reading and the watchdog tell
        self._command = command
        log.requested.append(requested)
        log.u_in.append(command[0])
        log.u_out.append(command[1])
        return None

    def _refused(self, error: RefusedError) -> RunResult:
        flags = getattr(error.refusal, "flags", Flag.NONE)
        if flags & _CAUSES:
            return self._vented_by_device(flags)
        return self._ended("aborted", str(error))

    def _disturb(self, breath: int, step: int) -> None:
        """Announce and undo the perturbation of a perturbed run."""
        tube = self._run.perturbation
        if tube and not self._disturbed and (breath, step) == (PERTURBED_BREATH, PERTURBED_STEP):
            self._bench.operator.disturb(tube, True)
            self._disturbed = True

    def _ended(self, status: str, reason: str, vented_after: float = math.nan) -> RunResult:
        if self._disturbed:
            self._bench.operator.disturb(self._run.perturbation, False)
        return RunResult(
            status, reason, self._safety.trips, tuple(self._breaths), self._late_answers,
            self._limited, vented_after,
        )  # fmt: skip


_CAUSES = (
    Flag.COMMANDS_STOPPED | Flag.OUT_OF_RANGE | Flag.OVERPRESSURE | Flag.SENSOR_LOST
    | Flag.DEVICE_LATE
)  # fmt: skip


def _row(step: int, pressure: float, target: float, pip: float, previous: float) -> Floats:
    """The observation of a step, ``(1, ROW)``."""
    ahead = waveform.targets_ahead(step, pip)
    head = [step * protocol.DT, protocol.DT, pressure, target]
    return np.array([[*head, *ahead.tolist(), previous]])


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Collect garbage now and not for a while: a collection takes longer than a step may."""
    was = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


@dataclass(frozen=True)
class SessionEnd:
    """How a session ended.

    Attributes:
        complete: whether the plan is done.
        reason: why not; empty if it is.
        runs: runs of this session.
    """

    complete: bool
    reason: str
    runs: int


def run_plan(
    bench: Bench,
    plan: Plan,
    make_controller: MakeController,
    log: RawLog,
    *,
    about: Mapping[str, Any],
    before_lung: Callable[[str], str] = lambda lung: "",
    prepare_run: Callable[[PlannedRun], None] = lambda run: None,
) -> SessionEnd:
    """Run what is left of a plan.

    Args:
        bench: device, clock, operator.
        plan: what to run.
        make_controller: makes the controller of a run; called while the lung rests.
        log: of the plan; what it holds already is not run again.
        about: what the session's line in the log says besides the plan: device, operator, notes.
        before_lung: called once a lung is confirmed; returns why not to go on, or nothing.
        prepare_run: called before each run; an emulator mounts the lung here.

    Returns:
        How it ended; the lung is vented in every case.

    Raises:
        InputError: if the log is of another plan.
        KeyboardInterrupt: if interrupted; the lung is vented.
    """
    logged = list(lines(log.path))
    state = progress(plan, logged)
    attempts = dict(state.attempts)
    if not any(line["type"] == "plan" for line in logged):
        log.append({"type": "plan", "plan": plan.as_dict()})
    log.append({"type": "session", **about, "safety": bench.settings.as_dict()})
    remaining = state.remaining(plan)
    end = SessionEnd(not remaining, "", 0)
    try:
        end = _runs(
            bench, plan, remaining, attempts, make_controller, log, before_lung, prepare_run
        )
    except EmergencyStop:
        end = SessionEnd(False, "the operator pressed the emergency stop", 0)
    except BaseException as error:
        end = SessionEnd(False, f"{type(error).__name__}: {error}", 0)
        raise
    finally:
        with contextlib.suppress(LinkError):
            bench.client.vent()
        log.append({"type": "session_ends", "complete": end.complete, "reason": end.reason})
    return end


def _runs(
    bench: Bench,
    plan: Plan,
    remaining: Sequence[PlannedRun],
    attempts: dict[int, int],
    make_controller: MakeController,
    log: RawLog,
    before_lung: Callable[[str], str],
    prepare_run: Callable[[PlannedRun], None],
) -> SessionEnd:
    mounted, spoilt, made = "", 0, 0
    queue = list(remaining)
    while queue:
        run = queue[0]
        if run.lung != mounted:
            reason = _mount(bench, run.lung, log, before_lung)
            if reason:
                return SessionEnd(False, reason, made)
            mounted = run.lung
        if run.kind == "ramp" and not bench.operator.confirm(
            f"{run.entry} on {run.lung}: raise PIP to {run.pip:g} cmH2O?"
        ):
            return SessionEnd(False, "the operator did not confirm the next PIP", made)
        prepare_run(run)
        try:
            result = _one(
                bench,
                run,
                attempts,
                make_controller,
                log,
                (len(plan.runs) - len(queue), len(plan.runs)),
            )
        except LinkError as error:
            # The device has vented or will: by the vent that follows, or by its watchdog.
            log.append({"type": "event", "what": "link", "message": str(error)})
            log.append(_run_line(run, attempts[run.number] - 1, "aborted", str(error)))
            spoilt += 1
            if spoilt > MAX_ATTEMPTS:
                raise
            bench.operator.tell(f"{error}; connecting again")
            bench.client.reconnect()
            log.append({"type": "event", "what": "reconnected"})
            continue
        made += 1
        if result.status == "aborted":
            spoilt += 1
            if spoilt >= MAX_ATTEMPTS or not bench.operator.confirm(
                f"{result.reason}. Mend the bench; run it again?"
            ):
                return SessionEnd(False, result.reason, made)
            continue
        spoilt = 0
        queue.pop(0)
        if result.status == "failed" and run.kind == "ramp":
            # What fails on the way up would fail at the top, with more pressure.
            reason = f"{run.entry} failed on {run.lung} at PIP {run.pip:g}: {result.reason}"
            skipped = [x for x in queue if x.entry == run.entry and x.lung == run.lung]
            for other in skipped:
                log.append(_run_line(other, attempts.get(other.number, 0), "failed", reason))
            queue = [x for x in queue if x not in skipped]
            bench.operator.tell(f"{reason}; its other runs on this lung are left out")
    return SessionEnd(True, "", made)


def _mount(bench: Bench, lung: str, log: RawLog, before_lung: Callable[[str], str]) -> str:
    """Have a lung set and checked; returns why not to go on, or nothing."""
    if not bench.operator.confirm(f"set the lung to {lung} and connect it. Is it set?"):
        return f"the operator did not confirm lung {lung}"
    log.append({"type": "event", "what": "lung", "lung": lung})
    return before_lung(lung)


def _one(
    bench: Bench,
    run: PlannedRun,
    attempts: dict[int, int],
    make_controller: MakeController,
    log: RawLog,
    place: tuple[int, int],
) -> RunResult:
    done, total = place
    attempt = attempts.get(run.number, 0)
    attempts[run.number] = attempt + 1
    log.append({"type": "run_begins", "run": run.number, "attempt": attempt, "time": time.time()})
    try:
        controller = control_pid(run) if run.entry == CONTROL else make_controller(run)
    except ControllerFailedError as error:
        log.append(_run_line(run, attempt, "failed", str(error)))
        return RunResult("failed", str(error), (), (), 0, 0)

    def on_breath(index: int, breath: BreathLog) -> None:
        log.append(breath.line(run, attempt, index))
        if bench.view is not None:
            bench.view.breath(run, breath, done, total)

    try:
        result = run_once(bench, run, controller, on_breath=on_breath)
    finally:
        controller.close()
    line = _run_line(run, attempt, result.status, result.reason)
    log.append(
        {
            **line,
            "error": None if math.isnan(result.error) else result.error,
            "late_answers": result.late_answers,
            "limited": result.limited,
            "trips": [vars(trip) for trip in result.trips],
        }
    )
    return result


def _run_line(run: PlannedRun, attempt: int, status: str, reason: str) -> dict[str, Any]:
    about = {"run": run.number, "attempt": attempt, "status": status, "reason": reason}
    label = {"entry": run.entry, "kind": run.kind, "lung": run.lung, "pip": run.pip}
    return {"type": "run", **about, **label, "repeat": run.repeat}


def dry_run(plan: Plan, make_controller: MakeController, settings: SafetySettings) -> list[str]:
    """Run every distinct run of a plan once on the frozen simulators, by the same code.

    Repetitions are left out: on a simulator they are the same.

    Args:
        plan: what is to run on the bench.
        make_controller: makes the controller of a run.
        settings: of the safety.

    Returns:
        What went wrong, one sentence each; empty if the plan is safe there.
    """
    from hardware_eval.device.loopback import loopback
    from hardware_eval.device.simulated import simulated_lung

    problems: list[str] = []
    seen: set[tuple[Any, ...]] = set()
    mounted, bench = "", None
    for run in plan.runs:
        key = (run.kind == "control", run.entry, run.lung, run.pip)
        if key in seen or run.kind == "perturbed":
            continue
        seen.add(key)
        if bench is None or run.lung != mounted:
            device, mounted = loopback(simulated_lung(run.lung)), run.lung
            client = Client(device, device.clock)
            client.hello()
            bench = Bench(client, device.clock, settings, SilentOperator(), rest=1.0)
        try:
            controller = control_pid(run) if run.entry == CONTROL else make_controller(run)
        except ControllerFailedError as error:
            problems.append(f"{run.entry} on {run.lung}: {error}")
            continue
        try:
            result = run_once(bench, run, controller)
        finally:
            controller.close()
        if result.status != "complete":
            problems.append(f"{run.entry} on {run.lung} at PIP {run.pip:g}: {result.reason}")
    return problems


class SilentOperator:
    """Confirms everything; for dry runs, tests and ``--yes``."""

    def confirm(self, question: str) -> bool:
        """Yes."""
        return True

    def tell(self, text: str) -> None:
        """Say nothing."""

    def stop(self) -> bool:
        """No key to press."""
        return False

    def disturb(self, perturbation: str, on: bool) -> None:
        """No hand to do it."""
