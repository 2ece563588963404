"""A session at the bench: what is left of a plan, lung by lung and run by run, written down."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, replace
from typing import Any

from hardware_eval.bench.controllers import (
    ControllerFailedError,
    Lateness,
    MakeController,
    control_pid,
)
from hardware_eval.bench.fallback import BOUNDS
from hardware_eval.bench.loop import (
    Bench,
    BreathLog,
    EmergencyStop,
    Operator,
    RunResult,
    run_once,
)
from hardware_eval.bench.plan import CONTROL, LogLine, Plan, PlannedRun, progress
from hardware_eval.bench.raw_log import RawLog, lines
from hardware_eval.bench.selftest import PARTS, Sheet
from hardware_eval.realtime import take_priority
from hardware_eval.wire.client import Client, LinkError

#: Tests a lung by its label; None where nobody does.
LungTest = Callable[[str], Sheet | None]

#: Entry, lung, PIP and error, cmH2O, of runs on simulators.
Simulated = list[tuple[str, str, float, float]]

#: Runs that the bench spoils in a row before the session gives up.
MAX_ATTEMPTS = 3

#: Runs that a busy host, a slow line or a device that restarts ends in a row before the session
#: gives up.
MAX_HELD_UP = 10

#: What is said of a host that is late time and again.
_BUSY = f" ({MAX_HELD_UP} times in a row: close other programs, allow real-time priority)"

#: What a run's line in the log takes from its result as it is.
_COUNTED = ("asked", "late_answers", "limited", "outside", "fallback", "longest_fallback")


def run_plan(
    bench: Bench,
    plan: Plan,
    make_controller: MakeController,
    log: RawLog,
    *,
    about: Mapping[str, Any],
    before_lung: LungTest = lambda lung: None,
) -> str:
    """Run what is left of a plan.

    Args:
        bench: device, clock, operator.
        plan: what to run.
        make_controller: makes the controller of a run; called while the lung rests.
        log: of the plan; what it holds already is not run again.
        about: what the session's line in the log says besides the plan: device, operator, notes.
        before_lung: tests a lung once it is confirmed; None where nobody does.

    Returns:
        Why the plan is not done; empty if it is. The lung is vented in every case.

    Raises:
        InputError: if the log is of another plan.
        KeyboardInterrupt: if interrupted; the lung is vented.
    """
    logged = lines(log.path)
    remaining, attempts = progress(plan, logged)
    if not any(line["type"] == "plan" for line in logged):
        log.append({"type": "plan", "plan": plan.as_dict()})
    own = asdict(BOUNDS) if bench.fallback else None
    log.append(
        {"type": "session", **about, "safety": {**bench.settings.as_dict(), "fallback": own}}
    )
    reason = ""
    try:
        reason = _runs(bench, plan, remaining, attempts, make_controller, log, before_lung)
    except EmergencyStop:
        reason = "the operator pressed the emergency stop"
    except BaseException as error:
        reason = f"{type(error).__name__}: {error}"
        raise
    finally:
        with contextlib.suppress(LinkError):
            bench.client.vent()
        log.append({"type": "session_ends", "complete": not reason, "reason": reason})
    return reason


def _runs(
    bench: Bench,
    plan: Plan,
    remaining: Sequence[PlannedRun],
    attempts: dict[int, int],
    make_controller: MakeController,
    log: RawLog,
    before_lung: LungTest,
) -> str:
    mounted, spoilt, held_up = "", 0, 0
    queue = list(remaining)
    while queue:
        run = queue[0]
        if run.lung != mounted:
            reason = _mount(bench, run.lung, log, before_lung)
            if reason:
                return reason
            mounted = run.lung
        if run.kind == "ramp" and not bench.operator.confirm(
            f"{run.entry} on {run.lung}: raise PIP to {run.pip:g} cmH2O?"
        ):
            return "the operator did not confirm the next PIP"
        try:
            place = len(plan.runs) - len(queue), len(plan.runs)
            result = _one(bench, run, attempts, make_controller, log.append, place)
        except LinkError as error:
            # The device has vented or will: by the vent that follows, or by its watchdog.
            log.append({"type": "event", "what": "link", "message": str(error)})
            log.append(_ended(run, attempts[run.number] - 1, "aborted", str(error)))
            held_up += 1
            if held_up >= MAX_HELD_UP:
                raise
            bench.operator.tell(f"{error}; connecting again")
            bench.client.reconnect()
            log.append({"type": "event", "what": "reconnected"})
            continue
        if result.held_up and held_up + 1 < MAX_HELD_UP:
            held_up += 1
            bench.operator.tell(f"{result.reason}: host or line was held up; the run is repeated")
            continue
        if result.status == "aborted":
            spoilt += 1
            reason = f"{result.reason}{_BUSY if result.held_up else ''}"
            if spoilt >= MAX_ATTEMPTS or not bench.operator.confirm(
                f"{reason}. Mend the bench; run it again?"
            ):
                return reason
            continue
        spoilt = held_up = 0
        queue.pop(0)
        if result.status == "failed" and run.kind == "ramp":
            # What fails on the way up would fail at the top, with more pressure.
            reason = f"{run.entry} failed on {run.lung} at PIP {run.pip:g}: {result.reason}"
            skipped = [x for x in queue if x.entry == run.entry and x.lung == run.lung]
            for other in skipped:
                log.append(_ended(other, attempts.get(other.number, 0), "failed", reason))
            queue = [x for x in queue if x not in skipped]
            bench.operator.tell(f"{reason}; its other runs on this lung are left out")
    return ""


def _mount(bench: Bench, lung: str, log: RawLog, before_lung: LungTest) -> str:
    """Have a lung set and tested; returns why not to go on, or nothing."""
    if not bench.operator.confirm(f"set the lung to {lung} and connect it. Is it set?"):
        return f"the operator did not confirm lung {lung}"
    log.append({"type": "event", "what": "lung", "lung": lung})
    sheet = before_lung(lung)
    told = {"lung": lung, "skipped": list(PARTS)} if sheet is None else sheet.as_dict()
    log.append({"type": "selftest", **told})
    if sheet is None or sheet.go:
        return ""
    return "the self-test says no-go: " + "; ".join(sheet.problems())


def _one(
    bench: Bench,
    run: PlannedRun,
    attempts: dict[int, int],
    make_controller: MakeController,
    log: Callable[[LogLine], None],
    place: tuple[int, int],
) -> RunResult:
    done, total = place
    attempt = attempts.get(run.number, 0)
    attempts[run.number] = attempt + 1
    log({"type": "run_begins", "run": run.number, "attempt": attempt, "time": time.time()})
    try:
        controller = control_pid(run) if run.entry == CONTROL else make_controller(run)
    except ControllerFailedError as error:
        log(_ended(run, attempt, "failed", str(error)))
        return RunResult((str(error),), "failed")

    def write(index: int, breath: BreathLog) -> None:
        log(breath.line(run, attempt, index))
        for show in bench.shows:
            show(run, breath, done, total)

    # A disk can take longer than a step; the thread has the loop's priority, or Python's lock would
    # wait for it.
    written: list[Future[None]] = []
    with ThreadPoolExecutor(1, "log", initializer=take_priority) as writer:
        try:
            result = run_once(
                bench,
                run,
                controller,
                on_breath=lambda index, breath: written.append(writer.submit(write, index, breath)),
            )
        finally:
            controller.close()
    for each in written:
        each.result()
    for trip in result.trips:
        bench.operator.tell(trip.alarm)
    if not result.trips and math.isfinite(result.vented_after):
        bench.operator.tell(f"high priority alarm: {result.reason}")
    log(
        {
            **_ended(run, attempt, result.status, result.reason),
            **{name: getattr(result, name) for name in _COUNTED},
            "error": None if math.isnan(result.error) else result.error,
            "longest_answer": round(result.longest_answer, 6),
            "beside": vars(result.beside),
            "trips": [vars(trip) for trip in result.trips],
        }
    )
    return result


def _ended(run: PlannedRun, attempt: int, status: str, reason: str) -> LogLine:
    return run.line("run", attempt, status=status, reason=reason)


def dry_run(
    bench: Bench, plan: Plan, make_controller: MakeController
) -> tuple[list[str], Simulated]:
    """Run every distinct run of a plan once on the frozen simulators, by the code of a bench.

    Repetitions are left out: on a simulator they are the same. Lungs start as on the bench, vented
    for the same time.

    Args:
        bench: whose safety, rest and fallback are those of the dry run; it is not touched.
        plan: what is to run on the bench.
        make_controller: makes the controller of a run.

    Returns:
        What went wrong, one sentence each, empty if the plan is safe there; and entry, lung, PIP
        and error, cmH2O, of each run that completed.
    """
    from hardware_eval.emulation.emulator import LoopbackDevice
    from hardware_eval.emulation.simulated import simulated_lung

    problems: list[str] = []
    errors: Simulated = []
    for lung in plan.lungs:
        device = LoopbackDevice(simulated_lung(lung))
        client = Client(device, device.clock)
        client.hello()
        virtual = replace(
            bench,
            client=client,
            clock=device.clock,
            operator=Operator(),
            shows=(),
            lateness=Lateness(),
        )
        distinct: dict[tuple[str, float], PlannedRun] = {}
        for run in plan.runs:
            if run.lung == lung and run.kind != "perturbed":
                distinct.setdefault((run.entry, run.pip), run)
        for run in distinct.values():
            result = _one(virtual, run, {}, make_controller, lambda line: None, (0, 0))
            if result.status != "complete":
                problems.append(f"{run.entry} on {lung} at PIP {run.pip:g}: {result.reason}")
            elif run.kind != "control":
                errors.append((run.entry, lung, run.pip, round(result.error, 6)))
    return problems, errors
