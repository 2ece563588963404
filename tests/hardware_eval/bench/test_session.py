"""Sessions on the virtual clock: scores, lateness, safety, losses and restarts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from hardware_eval.bench import session
from hardware_eval.bench.controllers import ControllerFailedError, Count, PIController
from hardware_eval.bench.loop import Bench, EmergencyStop, Operator, RunResult, run_once
from hardware_eval.bench.plan import Plan, PlannedRun, make_plan
from hardware_eval.bench.raw_log import RawLog, breaths, lines
from hardware_eval.bench.safety import DEFAULT
from hardware_eval.bench.session import run_plan
from hardware_eval.wire.client import LinkError
from tests.hardware_eval.faults import Fault, FaultKind, FaultyDevice, LineFaultKind
from ventbench import rollout
from ventbench.controllers.pid import PID
from ventbench.task import protocol

LUNG = "R5C20"
GAINS = (2.0, 5.0)


def run(pip: float = 20.0, **about: Any) -> PlannedRun:
    return PlannedRun(0, about.pop("kind", "scored"), "pid", LUNG, pip, 1, **about)


class Scripted(PIController):
    """A PID whose answers are changed at some steps of the run."""

    longest_answer, beside = 0.045, Count()

    def __init__(self, change: Callable[[int, float], float | None] = lambda step, u: u) -> None:
        super().__init__(GAINS)
        self._change, self._step = change, -1
        self.rows: list[np.ndarray] = []

    def act(self, row: np.ndarray, budget: float) -> float | None:
        self._step += 1
        self.rows.append(row[0])
        return self._change(self._step, super().act(row, budget))


def vented(device: FaultyDevice) -> bool:
    last = device.actuations[-1]
    return (last.u_in, last.u_out) == (0.0, 1)


def test_a_run_scores_as_in_simulation(bench: Bench, device: FaultyDevice) -> None:
    simulated = rollout(PID(*GAINS), simulator="physics", lungs=[LUNG], pips=[20.0])
    controller = Scripted()
    result = run_once(bench, run(), controller)
    assert result.status == "complete"
    # The lung of the bench breathes on from breath to breath, and each reading takes 2 ms.
    assert result.error == pytest.approx(simulated.errors().loc[LUNG, 20.0], abs=0.1)
    assert vented(device)
    assert len(controller.rows) == protocol.BREATHS * protocol.INSPIRATION_STEPS
    first = controller.rows[protocol.INSPIRATION_STEPS]
    assert first[0] == 0.0
    assert first[-1] == pytest.approx(5.0, abs=0.01)  # the bias flow, as in scoring


def test_steps_are_at_absolute_deadlines(bench: Bench) -> None:
    result = run_once(bench, run(), Scripted())
    time = np.concatenate([breath.time for breath in result.breaths])
    assert np.diff(time) == pytest.approx(protocol.DT, abs=1e-9)
    assert max(max(breath.late) for breath in result.breaths) < 1e-9


def test_a_late_answer_repeats_the_last_command_and_counts(bench: Bench) -> None:
    result = run_once(bench, run(), Scripted(lambda step, u: None if step == 5 else u))
    assert result.status == "complete"
    assert (result.late_answers, result.asked) == (1, 102)
    u_in = result.breaths[0].u_in
    assert u_in[5] == u_in[4] != u_in[6]
    assert math.isnan(result.breaths[0].requested[5])


def test_an_entry_that_is_late_more_often_than_one_in_a_hundred_fails(bench: Bench) -> None:
    result = run_once(bench, run(), Scripted(lambda step, u: None if step in (5, 40) else u))
    assert result.status == "failed"
    assert "2 of 102 answers took longer than 22 ms, the longest 45 ms" in result.reason
    assert math.isnan(result.error)


def silent(
    device: FaultyDevice,
    after: float,
    steps: float,
    kind: FaultKind | LineFaultKind = LineFaultKind.SILENT,
) -> None:
    """Let line or sensor be silent ``after`` a run of 2 s of rest begins, s, for some steps."""
    begins = device.clock.now() - device.start + 2.0 + protocol.DT + after - 0.002
    faulty: Any = device.line if isinstance(kind, LineFaultKind) else device.service.hal
    faulty.faults = (Fault(kind, begins, begins + steps * protocol.DT),)


@pytest.mark.parametrize("step", [0, 4])
@pytest.mark.parametrize(
    ("kind", "early"),
    [(LineFaultKind.SILENT, 0.0), (FaultKind.SENSOR_LOST, 0.006)],  # of a sample's age
    ids=["answer", "reading"],
)
def test_a_step_without_an_answer_or_a_reading_costs_no_run(
    kind: FaultKind | LineFaultKind,
    early: float,
    step: int,
    bench: Bench,
    device: FaultyDevice,
) -> None:
    whole = run_once(bench, run(), Scripted())
    silent(device, (protocol.BREATH_STEPS + step) * protocol.DT - early, 0.9, kind)
    controller = Scripted()
    result = run_once(bench, run(), controller)
    # The controller is told that a breath begins, by the answer to the last command.
    assert np.isfinite(controller.rows).all()
    assert [row[0] for row in controller.rows].count(0.0) == protocol.BREATHS
    assert len(controller.rows) == result.asked == 102 - (step > 0)
    assert math.isnan(result.breaths[1].pressure[step]) == (step > 0)
    assert (result.status, result.late_answers) == ("complete", 0)
    assert result.error == pytest.approx(whole.error, abs=0.1)


def test_a_run_of_too_few_readings_runs_again(bench: Bench, device: FaultyDevice) -> None:
    begins = device.clock.now() - device.start + 2.0 + protocol.DT - 0.002
    steps = protocol.BREATH_STEPS + np.arange(2, 34, 4)
    device.line.faults = tuple(
        Fault(LineFaultKind.SILENT, begins + at * protocol.DT, begins + (at + 0.9) * protocol.DT)
        for at in steps
    )
    result = run_once(bench, run(), Scripted())
    assert (result.status, result.held_up) == ("aborted", True)
    assert "8 of 68 scored steps have no pressure, 1 in a row" in result.reason


def test_a_silent_line_ends_the_run_and_blames_neither_lung_nor_entry(
    bench: Bench, device: FaultyDevice
) -> None:
    silent(device, 0.5, 5.0)
    result = run_once(bench, run(), Scripted())
    assert (result.status, result.held_up) == ("aborted", True)
    assert {trip.check for trip in result.trips} == {"no_answer"}
    assert max(result.breaths[0].late) < protocol.DT  # the loop did not wait for it


def test_a_controller_that_fails_ends_its_run(bench: Bench, device: FaultyDevice) -> None:
    def fail(step: int, u_in: float) -> float:
        if step == 7:
            raise ControllerFailedError("it raised ValueError")
        return u_in

    result = run_once(bench, run(), Scripted(fail))
    assert (result.status, result.reason) == ("failed", "it raised ValueError")
    assert math.isnan(result.error)
    assert len(set(map(len, structs.astuple(result.breaths[-1])))) == 1
    assert vented(device)


def test_a_wide_open_valve_is_stopped_and_blames_the_controller(bench: Bench) -> None:
    result = run_once(bench, run(10.0), Scripted(lambda step, u: 100.0))
    assert result.status == "failed"
    assert result.trips[0].check == "over_pressure"
    assert result.vented_after < 0.005
    assert max(result.breaths[0].pressure) < protocol.SAFETY_PRESSURE


FAULTS = {
    "tube off": (Fault(FaultKind.DISCONNECTED, 0.0), {"low_pressure", "disconnected"}),
    "sensor stuck": (Fault(FaultKind.SENSOR_STUCK, 0.0), {"stuck_sensor"}),
    "sensor lost": (Fault(FaultKind.SENSOR_LOST, 0.0), {"no_reading"}),
    "expiratory valve stuck": (
        Fault(FaultKind.EXPIRATORY_STUCK, 0.0),
        {"expiratory_valve", "stuck_sensor"},
    ),
}


@pytest.mark.parametrize("name", sorted(FAULTS))
def test_a_fault_of_the_bench_stops_the_run(name: str, bench: Bench, device: FaultyDevice) -> None:
    fault, checks = FAULTS[name]
    hal: Any = device.service.hal
    # The lung rests for 2 s before the run.
    hal.faults = (replace(fault, start=device.clock.now() + 2.0 + 3.2),)
    result = run_once(bench, run(), Scripted())
    assert result.status in ("aborted", "failed")
    by_device = "vented" in result.reason or "armed" in result.reason
    assert by_device or result.trips[0].check in checks
    assert vented(device)


def test_a_cable_pulled_leaves_the_lung_vented(bench: Bench, device: FaultyDevice) -> None:
    def pull(step: int, u_in: float) -> float:
        if step == 10:
            device.unplug()
        return u_in

    with pytest.raises(LinkError):
        run_once(bench, run(), Scripted(pull))
    pulled = device.clock.now()
    device.clock.advance(0.2)
    assert vented(device)
    assert device.actuations[-1].time - pulled < 0.1


class StopsAt(Operator):
    def __init__(self, step: int) -> None:
        self.step, self.calls = step, 0

    def stop(self) -> bool:
        self.calls += 1
        return self.calls > self.step


@pytest.mark.parametrize("step", [0, 20, 140])
def test_the_emergency_stop_vents_at_once(step: int, bench: Bench, device: FaultyDevice) -> None:
    with pytest.raises(EmergencyStop):
        run_once(replace(bench, operator=StopsAt(step)), run(), Scripted())
    assert vented(device)


def test_ctrl_c_anywhere_leaves_the_lung_vented(bench: Bench, device: FaultyDevice) -> None:
    def interrupt(step: int, u_in: float) -> float:
        if step == 50:
            raise KeyboardInterrupt
        return u_in

    with pytest.raises(KeyboardInterrupt):
        run_once(bench, run(), Scripted(interrupt))
    assert vented(device)


class Disturbs(Operator):
    def __init__(self) -> None:
        self.done: list[tuple[str, bool]] = []

    def disturb(self, perturbation: str, on: bool) -> None:
        self.done.append((perturbation, on))


def test_a_perturbed_run_disturbs_the_tube_and_undoes_it(bench: Bench) -> None:
    person = Disturbs()
    run_once(
        replace(bench, operator=person), run(kind="perturbed", perturbation="leak"), Scripted()
    )
    assert person.done == [("leak", True), ("leak", False)]


class CrashError(BaseException):
    """Stands for ``kill -9``: nothing of the session runs after it but what cleans up itself."""


@pytest.fixture
def plan() -> Plan:
    return make_plan(["pid"], [LUNG], pips=(10.0,), repeats=2, control_every=0)


def work(bench: Bench, plan: Plan, path: Path, make: Callable[[PlannedRun], Any]) -> str:
    with RawLog(path) as log:
        return run_plan(bench, plan, make, log, about={})


def test_a_plan_survives_crashes_and_cables(
    bench: Bench, plan: Plan, device: FaultyDevice, tmp_path: Path
) -> None:
    path = tmp_path / "raw.jsonl"
    crashes = {30, 180, 250}  # steps of inspirations over all sessions
    pulls = {120}
    calls = 0

    def trouble(step: int, u_in: float) -> float:
        nonlocal calls
        calls += 1
        if calls in crashes:
            raise CrashError
        if calls in pulls:
            device.unplug()
            device.plug()  # back before anybody looks; what was on the way is lost
        return u_in

    ended = None
    for _ in range(len(crashes) + 1):
        try:
            ended = work(bench, plan, path, lambda run: Scripted(trouble))
        except CrashError:
            bench.client.hello()
    assert ended is not None
    assert ended == ""
    logged = breaths(lines(path))
    complete = {b.run.number for b in logged if b.complete}
    assert complete == {run.number for run in plan.runs}
    # Every breath that ended is in the log, also those of runs that were cut off.
    inspirations = sum(len(b.log.time) == protocol.BREATH_STEPS for b in logged)
    assert inspirations >= (calls - len(crashes) * 34) // protocol.INSPIRATION_STEPS - 1
    for number in complete:
        attempts = {b.attempt for b in logged if b.run.number == number and b.complete}
        assert len(attempts) == 1


def test_a_ramp_that_fails_leaves_the_rest_of_the_entry_out(
    bench: Bench, plan: Plan, tmp_path: Path
) -> None:
    path = tmp_path / "raw.jsonl"
    ended = work(bench, plan, path, lambda run: Scripted(lambda step, u: 100.0))
    assert ended == ""
    statuses = [x["status"] for x in lines(path) if x["type"] == "run"]
    assert statuses == ["failed"] * len(plan.runs)
    assert len(breaths(lines(path))) == 1


def test_an_operator_who_does_not_confirm_ends_the_session(
    bench: Bench, plan: Plan, tmp_path: Path
) -> None:
    class Refuses(Operator):
        def confirm(self, question: str) -> bool:
            return False

    ended = work(
        replace(bench, operator=Refuses()), plan, tmp_path / "raw.jsonl", lambda run: Scripted()
    )
    assert "confirm" in ended


def test_a_dry_run_finds_a_controller_that_is_unsafe(bench: Bench) -> None:
    calm = make_plan(["pid"], [LUNG], pips=(10.0,), repeats=5, control_every=0)
    problems, errors = session.dry_run(bench, calm, lambda run: Scripted(lambda step, u: 100.0))
    assert len(problems) == 1
    assert "over pressure" in problems[0]
    assert errors == []


def test_the_dry_run_has_the_fallback_of_the_run(bench: Bench) -> None:
    calm = make_plan(["pid"], [LUNG], pips=(10.0,), repeats=5, control_every=0)
    guarded = replace(bench, fallback=True)
    problems, _ = session.dry_run(guarded, calm, lambda run: Scripted(lambda step, u: 100.0))
    assert len(problems) == 1
    assert "were outside the envelope" in problems[0]


def test_a_result_without_scored_breaths_has_no_error() -> None:
    assert math.isnan(RunResult(("x",), "failed").error)


@pytest.mark.slow
def test_six_lungs_survive_three_crashes_and_two_cables(tmp_path: Path) -> None:
    """A plan over all lungs: every breath that ended is in the log, and every run is done once."""
    from hardware_eval.emulation.simulated import simulated_lung
    from hardware_eval.wire.client import Client
    from ventbench.task.lungs import LUNG_IDS

    lungs = {name: simulated_lung(name, "physics") for name in LUNG_IDS}
    device = FaultyDevice(simulated_lung(LUNG, "physics"))
    for other in lungs.values():  # another lung on the same ventilator
        other.identity = device.service.hal.identity
    client = Client(device, device.clock)
    client.hello()
    everything = make_plan(["pid"], LUNG_IDS, pips=(10.0,), repeats=2, control_every=0)
    random = np.random.default_rng(5)
    steps = len(everything.runs) * protocol.BREATHS * protocol.INSPIRATION_STEPS
    moments = np.sort(random.choice(steps, 5, replace=False))
    crashes, pulls = set(moments[::2].tolist()), set(moments[1::2].tolist())
    calls, ended = 0, 0

    def trouble(step: int, u_in: float) -> float:
        nonlocal calls
        calls += 1
        if calls in crashes:
            raise CrashError
        if calls in pulls:
            device.unplug()
            device.plug()
        return u_in

    def mount(lung: str) -> None:
        device.service.hal = lungs[lung]

    def count(run: PlannedRun, breath: Any, done: int, total: int) -> None:
        nonlocal ended
        ended += len(breath.time) == protocol.BREATH_STEPS

    bench = Bench(client, device.clock, DEFAULT, Operator(), [count], 1.0)
    path, result, restarts = tmp_path / "raw.jsonl", None, 0
    while result is None:
        try:
            with RawLog(path) as log:
                result = run_plan(
                    bench,
                    everything,
                    lambda run: Scripted(trouble),
                    log,
                    about={},
                    before_lung=mount,
                )
        except CrashError:
            restarts += 1
            client.hello()
    assert result == ""
    assert restarts == 3
    logged = breaths(lines(path))
    assert sum(len(b.log.time) == protocol.BREATH_STEPS for b in logged) == ended
    complete = [(b.run.number, b.breath) for b in logged if b.complete]
    assert sorted(complete) == [
        (run.number, k) for run in everything.runs for k in range(protocol.BREATHS)
    ]
