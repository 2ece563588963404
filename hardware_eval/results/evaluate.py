"""The evaluation of entries on a bench, from the first check to the record."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from hardware_eval import realtime
from hardware_eval.bench import bringup, session
from hardware_eval.bench.calibrate import Calibration
from hardware_eval.bench.controllers import (
    ControllerFailedError,
    EmptyController,
    LiveController,
    MakeController,
    SubmissionController,
)
from hardware_eval.bench.loop import Bench, Operator, Show
from hardware_eval.bench.plan import UNDISTURBED, Plan, PlannedRun, Procedure
from hardware_eval.bench.raw_log import LOG, RECORDING, RawLog, lines, write_recording
from hardware_eval.bench.safety import SafetySettings
from hardware_eval.bench.selftest import Sheet, chosen_parts, selftest
from hardware_eval.realtime import ENTRY_PRIORITY, Clock, RealClock
from hardware_eval.results import acceptance, page
from hardware_eval.results import record as records
from hardware_eval.wire.client import Client, Link
from hardware_eval.wire.messages import Capability
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.entries.folder import Submission, open_submission
from ventbench.sandbox.child.cell import SubmissionError
from ventbench.task import protocol
from ventbench.task.interfaces import Task

if TYPE_CHECKING:
    from hardware_eval.emulation.emulator import LoopbackDevice


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation made."""

    reason: str  #: why the plan is not done; empty if it is.
    log: Path  #: the raw recording.
    #: all whole breaths of an undisturbed tube in the public schema; None if there is none.
    recording: Path | None
    #: path of each entry's hardware record; empty until the plan is done.
    records: Mapping[str, Path]
    #: entries that have no score, as a run of theirs failed, and why, by name.
    stopped: Mapping[str, str]
    #: those of them of which every run failed, so that there is nothing for the board.
    unrun: frozenset[str]


@dataclass(frozen=True)
class Line:
    """A device and the time that it lives in."""

    client: Client  #: of the device.
    clock: Clock  #: real, or the loopback device's.
    #: the device if it is emulated in this process, else None.
    device: LoopbackDevice | None = None
    port: str = "virtual"  #: what carries the bytes, see :func:`port_kind`.
    #: the bring-up of a real device, see :mod:`hardware_eval.bench.bringup`; empty for software.
    bringup: Mapping[str, Any] = field(default_factory=dict)


#: Ports behind which there is software, whatever the device says of itself.
EMULATED_PORTS = frozenset({"virtual", "pseudo-terminal", "own socket"})

#: Major numbers of Linux's pseudo-terminals.
_PSEUDO_TERMINALS = range(136, 144)


def port_kind(port: str) -> str:
    """What a port is: ``virtual``, ``pseudo-terminal``, ``own socket``, ``socket`` or ``serial``.

    No ventilator is on a pseudo-terminal or on a socket of the host itself.
    """
    if port.startswith(VIRTUAL):
        return "virtual"
    if "://" in port:
        host = urlsplit(port).hostname or "localhost"
        own = host == "localhost" or host.startswith("127.") or host == "::1"
        return "own socket" if own else "socket"
    path = os.path.realpath(port)
    with contextlib.suppress(OSError):
        if sys.platform == "linux" and os.major(os.stat(path).st_rdev) in _PSEUDO_TERMINALS:
            return "pseudo-terminal"
    return "pseudo-terminal" if re.fullmatch(r"/dev/(pts/\d+|ttys\d+)", path) else "serial"


#: Longest time that a session's empty controller lives, s.
SESSION_S = 30 * 24 * 3600.0

#: Begins a port that is an emulated device in this process, on a virtual clock.
VIRTUAL = "virtual:"


def carrier(port: str) -> tuple[Link | LoopbackDevice, Clock]:
    """Open a port, say nothing, and return it with the clock it lives by; see :func:`connect`."""
    if not port.startswith(VIRTUAL):
        _await(port)
        return Link(port), RealClock()
    from hardware_eval.emulation.emulator import LoopbackDevice
    from hardware_eval.emulation.simulated import PVP_SENSOR, simulated_lung

    # Without noise all repeats would be one.
    lung = simulated_lung(port.removeprefix(VIRTUAL), sensor=PVP_SENSOR)
    device = LoopbackDevice(lung)
    return device, device.clock


#: How long an emulator may take to compile its lung, s, and how often it is looked for.
_COMPILES, _LOOK = 60.0, 0.2


def _await(port: str) -> None:
    """Wait for the link of an emulator, which makes it once its lung answers."""
    if "://" in port or port.startswith("/dev/") or os.path.exists(port):
        return
    print(f"waiting for {port}: is an emulator starting? Ctrl-C ends this", file=sys.stderr)
    for _ in range(round(_COMPILES / _LOOK)):
        if os.path.exists(port):
            return
        time.sleep(_LOOK)


def connect(port: str, confirmed: bool = True) -> Line:
    """Open a port, and a session; a real device must have been brought up, if it shall be so.

    It is a serial port or socket, in real time; or ``virtual:R20C50``, an emulated lung in this
    process on a virtual clock, where breaths take a fraction of a second.

    Raises:
        LinkError: if it cannot be opened, or no device answers.
        InputError: if there is no such emulated lung, or a real device was not brought up.
    """
    transport, clock = carrier(port)
    kind = port_kind(port)
    client = Client(transport, clock, emulated=kind in EMULATED_PORTS)
    try:
        client.hello()
        found = {} if client.simulated or not confirmed else bringup.load(client)
    except InputError:
        client.close()
        raise
    device = None if isinstance(transport, Link) else transport
    return Line(client, clock, device, kind, found)


def device_about(line: Line) -> dict[str, Any]:
    """A device as records name it.

    Software is told by the port that the host opened; a device may also say that it is simulated,
    but not that it is not.
    """
    welcome = line.client.identity
    simulated = bool(welcome.capabilities & Capability.SIMULATED)
    return {
        "name": welcome.name,
        "firmware": ".".join(map(str, welcome.firmware)),
        "calibration": welcome.calibration.hex(),
        "emulated": simulated or line.port in EMULATED_PORTS,
        "about": {
            "port": line.port,
            "says_simulated": simulated,
            "device_id": welcome.device_id.hex(),
            "wire_protocol": welcome.version,
            "watchdog_s": round(welcome.watchdog, 4),
            "pressure_limit_cmH2O": round(welcome.pressure_limit, 2),
        },
    }


def open_entries(names: Sequence[str], track: str | None) -> tuple[list[Submission], str]:
    """Open submissions and settle the track.

    Raises:
        SubmissionError: if one cannot be opened or does not enter the track.
    """
    opened = [open_submission(name) for name in names]
    track = track or opened[0].manifest.tracks[0]
    for submission in opened:
        if track not in submission.manifest.tracks:
            raise SubmissionError(f"{submission.label}: does not enter the track {track}")
    return opened, track


def begun_plan(out: Path) -> Mapping[str, Any] | None:
    """The plan that a folder's log begins with; None before the first session."""
    if not (out / LOG).exists():
        return None
    return next((x["plan"] for x in lines(out / LOG) if x["type"] == "plan"), None)


def controllers(
    submissions: Sequence[Submission],
    track: str,
    runner: Any,
    empty: EmptyController | None = None,
) -> MakeController:
    """A function that makes the controller of a run, in a process of its own as in scoring.

    An ``empty`` one runs beside each, if there is one.
    """
    by_name = {submission.manifest.name: submission for submission in submissions}

    def make(run: PlannedRun) -> LiveController:
        lung = run.lung if track == "performance" else None
        task = Task(track, lung, protocol.DT, protocol.INSPIRATION_STEPS)
        try:
            return SubmissionController(runner, by_name[run.entry], task, empty)
        except SubmissionError as error:
            raise ControllerFailedError(str(error)) from error

    return make


def make_runner(sandbox: bool, total_s: float = 120.0) -> Any:
    """The sandbox of scoring, or this process for code that is trusted.

    A run lasts 9 s and the loop does not wait; a controller silent for 2 s has failed. ``total_s``:
    the longest time that one lives.
    """
    if sandbox:
        from ventbench.sandbox.pipes import Allowance
        from ventbench.sandbox.runner import SandboxRunner

        return SandboxRunner(
            allowance=Allowance(patience_s=2.0, total_s=total_s, priority=ENTRY_PRIORITY)
        )
    from ventbench.entries.cells import InProcessRunner

    return InProcessRunner()


def evaluate(
    submissions: Sequence[Submission],
    line: Line,
    out: Path,
    operator: Operator,
    *,
    plan: Plan,
    how: Procedure,
    shows: Sequence[Show] = (),
    sandbox: bool = True,
    operator_name: str = "",
    calibration: Calibration = Calibration({}, {}),  # noqa: B008 - it is frozen
) -> Evaluation:
    """Run a plan, or what is left of it, and make the records once it is done.

    Args:
        submissions: the entries of the plan.
        line: to the device.
        out: folder of the log, the recording and the records.
        operator: the person at the bench.
        plan: from :func:`hardware_eval.bench.plan.make_plan`.
        how: limits, notes, dry run, self-tests and rests.
        shows: show breaths.
        sandbox: run entries as in scoring; without it, in this process.
        operator_name: for the record.
        calibration: of the device, for the record and the self-tests.

    Raises:
        InputError: if the log is of another plan, a limit or a part of the self-test is none,
            nobody can disturb the tube, or the dry run finds the plan unsafe.
        LinkError: if the device is lost and does not come back.
    """
    if plan.perturbations and line.port in EMULATED_PORTS and line.device is None:
        raise InputError(
            "nobody can disturb the tube of an emulator in another process: leave `perturb` out of "
            "the plan, or use a port such as virtual:R20C20, which disturbs it by itself"
        )
    left_out = chosen_parts(how.skip)
    settings = SafetySettings(largest_u_in=how.largest_u_in, largest_rise=how.largest_rise)
    bench = Bench(line.client, line.clock, settings, operator, shows, how.rest, how.fallback)
    runner = make_runner(sandbox)
    log_path = out / LOG
    simulated: session.Simulated = []
    if how.dry_run and begun_plan(out) is None:
        operator.tell("dry run on the frozen simulators")
        make = controllers(submissions, plan.track, runner)
        problems, simulated = session.dry_run(bench, plan, make)
        if problems:
            raise InputError(
                "the dry run on the simulators stopped: " + "; ".join(problems) + ". Nothing was "
                "sent to the bench; `dry_run = false` in the plan skips this"
            )
    device = device_about(line)
    if line.bringup:
        device["about"]["bringup"] = dict(line.bringup)
    if calibration.parts:
        device["about"]["calibration_file"] = calibration.about()
    about = {
        "device": device,
        "operator": operator_name,
        "notes": how.notes,
        "entries": {x.manifest.name: x.sha256 for x in submissions},
        "sandbox": None if runner.sandbox is None else dict(runner.sandbox),
        "simulated": simulated,
    }

    def tested(lung: str) -> Sheet | None:
        if not how.selftest:
            return None
        sheet = selftest(bench, lung, baseline=calibration.baseline(), skip=left_out)
        files.write_json(out / f"selftest-{lung}.json", sheet.as_dict())
        operator.tell(str(sheet))
        return sheet

    with contextlib.ExitStack() as stack:
        empty = None
        if isinstance(line.clock, RealClock):  # a controller can be late
            empty = EmptyController(make_runner(sandbox, SESSION_S))
            stack.callback(empty.close)
            with realtime.priority() as granted:
                about["priority"] = granted or realtime.has_priority()
            if not about["priority"]:
                operator.tell(f"{realtime.DENIED}; a busy host is late more often")
        make = controllers(submissions, plan.track, runner, empty)
        log = stack.enter_context(RawLog(log_path))
        stack.enter_context(_ends_by_exception())
        # The loop's thread waits at most half a millisecond for another.
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(0.0005)
        reason = session.run_plan(bench, plan, make, log, about=about, before_lung=tested)
    written: Path | None = None
    with contextlib.suppress(InputError):  # no whole breath yet
        write_recording(out, UNDISTURBED)
        written = out / RECORDING
    made: dict[str, Path] = {}
    stopped: dict[str, str] = {}
    unrun: set[str] = set()
    for submission in () if reason else submissions:
        name = submission.manifest.name
        content, checked = records.hardware_record(log_path, submission)
        made[name] = records.save(out, content)
        if stops := checked.header.stops:
            runs = checked.errors.size
            stopped[name] = f"{len(stops)} of {runs} runs failed, the first: {stops[0].reason}"
            if len(stops) == runs:
                unrun.add(name)
    with contextlib.suppress(InputError):  # without jinja2, or a complete run
        page.write(out)
        acceptance.write(out)
    return Evaluation(reason, log_path, written, made, stopped, frozenset(unrun))


@contextlib.contextmanager
def _ends_by_exception() -> Iterator[None]:
    """Turn the signals that end a process into an exception, so that the lung is vented first."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt(signal.Signals(number).name)

    with contextlib.ExitStack() as stack:
        for number in (signal.SIGTERM, signal.SIGHUP):
            with contextlib.suppress(ValueError):  # not in the main thread: the caller's business
                stack.callback(signal.signal, number, signal.signal(number, interrupt))
        yield
