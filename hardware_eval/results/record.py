"""From the log of a plan to the hardware records of its entries, and to a public recording.

The record holds the measured pressures of every scored inspiration, from which the score follows,
and names the raw log by its hash. ``ventbench board add`` takes it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.loop import ON_TIME_S
from hardware_eval.bench.plan import CONTROL, Plan, make_plan, progress
from hardware_eval.bench.raw_log import LoggedBreath, breaths, lines
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import canonical, create, record, schema
from ventbench.board.record import TRACK, HardwareRecord
from ventbench.entries.folder import Submission, combined_hash, file_hashes
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics.score import passes_safety_gate

#: Longest reason of a stopped run in a record, characters.
_REASON = 1000


@dataclass(frozen=True)
class Jitter:
    """Statistics of the loop's deadlines.

    Attributes:
        steps: how many there were.
        on_time: share of steps that began within 2 ms of their deadline.
        lost: steps that began after the deadline of the next one.
        worst: how late the latest step began, s.
        late_answers: steps whose controller did not answer in time.
        late_share: their share of the steps whose controller was asked.
        longest_answer: longest time that an answer took, s.
        outside: answers that the fallback refused.
        fallback_share: share of the steps that the fallback commanded.
        longest_fallback: steps in a row that it commanded, at most.
        busy_median, busy_worst: time from a step's beginning to its command's answer, s.
    """

    steps: int
    on_time: float
    lost: int
    worst: float
    late_answers: int
    late_share: float
    longest_answer: float
    outside: int
    fallback_share: float
    longest_fallback: int
    busy_median: float
    busy_worst: float


def plan_of(logged: list[dict[str, Any]], label: str) -> Plan:
    """The plan of a log.

    Raises:
        InputError: if it holds none.
    """
    for line in logged:
        if line["type"] == "plan":
            given = line["plan"]
            return make_plan(
                given["entries"], given["lungs"], track=given["track"],
                pips=given["pips"], repeats=given["repeats"],
                control_every=given["control_every"], perturbations=given["perturbations"],
                seed=given["seed"],
            )  # fmt: skip
    raise InputError(f"{label} holds no plan: no session has begun")


def jitter(log: Path, entry: str | None = None) -> Jitter:
    """Statistics of all steps of a log; answers of one entry's runs, or of all.

    Raises:
        InputError: if it holds no step.
    """
    late, busy, longest = [], [], {"longest_answer": 0.0, "longest_fallback": 0}
    sums = {"late_answers": 0, "asked": 0, "outside": 0, "fallback": 0}
    for line in lines(log):
        if line["type"] == "breath":
            late += line["late"]
            busy += line["busy"]
        if line["type"] == "run" and line["entry"] == (entry or line["entry"]):
            sums = {name: value + line.get(name, 0) for name, value in sums.items()}
            longest = {name: max(value, line.get(name, 0)) for name, value in longest.items()}
    if not late:
        raise InputError(f"{log} holds no breath")
    delays, asked = np.array(late, float), max(sums["asked"], 1)
    return Jitter(
        len(delays), float(np.mean(delays <= ON_TIME_S)), int(np.sum(delays > protocol.DT)),
        float(delays.max()), sums["late_answers"], sums["late_answers"] / asked,
        longest["longest_answer"], sums["outside"], sums["fallback"] / asked,
        int(longest["longest_fallback"]), float(np.median(busy)), float(np.max(busy)),
    )  # fmt: skip


def hardware_record(log: Path, submission: Submission) -> bytes:
    """Make the hardware record of an entry, with the files that ran, from the log of a plan.

    It is canonical JSON, checked as the leaderboard checks it.

    Raises:
        InputError: if the plan is not finished, the entry is not in it, or its files have changed.
    """
    logged = list(lines(log))
    plan = plan_of(logged, str(log))
    name = submission.manifest.name
    if name not in plan.entries:
        raise InputError(f"{log} is of {', '.join(plan.entries)}, not of {name}")
    left = [run for run in progress(plan, logged).remaining(plan) if run.entry == name]
    if left:
        raise InputError(
            f"{log}: {len(left)} runs of {name} are left; run the same command again, it continues"
        )
    sessions = [line for line in logged if line["type"] == "session"]
    _check_same(sessions, log, name)
    about = sessions[-1]
    hashes = file_hashes(submission.folder)
    if combined_hash(hashes) != submission.sha256 or submission.sha256 != about["entries"][name]:
        raise InputError(f"{submission.label} has changed since it ran; it needs a plan of its own")
    lungs = [lung for lung in LUNG_IDS if lung in plan.lungs]
    runs = _scored(log, name)
    content = {
        "format": schema.FORMAT,
        "kind": "hardware",
        "protocol": schema.PROTOCOL,
        "created": record.timestamp(),
        "track": TRACK,
        "simulated_track": plan.track,
        "submission": {
            "sha256": submission.sha256,
            "files": hashes,
            "manifest": dataclasses.asdict(submission.manifest),
        },
        "device": about["device"],
        "operator": about["operator"],
        "notes": about["notes"],
        "lungs": lungs,
        "pips": list(plan.pips),
        "repeats": plan.repeats,
        **_tables(plan, lungs, runs, logged, name),
        "recording": {
            "sha256": files.sha256(log),
            "bytes": log.stat().st_size,
            "breaths": sum(line["type"] == "breath" for line in logged),
        },
        "plan": plan.as_dict(),
        "control": _control(log),
        "safety": about["safety"],
        "selftest": _skipped(logged, lungs),
        "timing": dataclasses.asdict(jitter(log, name)),
        "sandbox": about["sandbox"],
        "provenance": {},
        "versions": create.versions(),
        "machine": create.machine(),
    }
    made = canonical.canonical(canonical.through_json(content))
    checked = record.from_bytes(made, f"the hardware record of {name}")
    assert isinstance(checked, HardwareRecord)
    return made


def _check_same(sessions: list[dict[str, Any]], log: Path, name: str) -> None:
    """Refuse a log whose sessions were of other devices, calibrations or files of the entry."""
    for key in ("device", "safety", "sandbox"):
        if any(session[key] != sessions[0][key] for session in sessions):
            raise InputError(f"{log}: {key} changed between sessions; a record needs one of it")
    if any(
        session["entries"].get(name) != sessions[0]["entries"].get(name) for session in sessions
    ):
        raise InputError(f"{log}: the files of {name} changed between sessions")


_Cell = tuple[str, float, int]


def _scored(log: Path, name: str) -> dict[_Cell, list[LoggedBreath]]:
    """Breaths of the complete scored runs of an entry, by lung, PIP and repetition."""
    runs: dict[_Cell, list[LoggedBreath]] = {}
    for breath in breaths(log):
        if breath.entry == name and breath.kind == "scored" and breath.complete:
            runs.setdefault((breath.lung, breath.pip, breath.repeat), []).append(breath)
    return runs


def _tables(
    plan: Plan, lungs: list[str], runs: Mapping[_Cell, list[LoggedBreath]],
    logged: list[dict[str, Any]], name: str,
) -> dict[str, Any]:  # fmt: skip
    """Errors, traces, stops and safety of every cell."""
    failed = {
        (line["lung"], line["pip"], line["repeat"]): line["reason"]
        for line in logged
        if line["type"] == "run" and line["status"] == "failed"
        and line["entry"] == name and line["kind"] == "scored"
    }  # fmt: skip
    errors, pressures, commands = [], [], []
    stops, safe, peaks = [], [], []
    for lung in lungs:
        peak, passed = 0.0, True
        for tables in (errors, pressures, commands):
            tables.append([[] for _ in plan.pips])
        for place, pip in enumerate(plan.pips):
            for repeat in range(1, plan.repeats + 1):
                cell = {"lung": lung, "pip": pip, "repeat": repeat}
                run = runs.get((lung, pip, repeat))
                if run is None:
                    reason, passed = failed.get((lung, pip, repeat), "stopped"), False
                    stops.append({**cell, "reason": reason[:_REASON]})
                    for tables in (errors, pressures, commands):
                        tables[-1][place].append(None)
                    continue
                rows = [run[k] for k in protocol.SCORED_BREATHS]
                inspired = np.stack([row.pressure[: protocol.INSPIRATION_STEPS] for row in rows])
                u_in = np.stack([row.u_in[: protocol.INSPIRATION_STEPS] for row in rows])
                milli = np.round(1000.0 * inspired).astype(int)
                errors[-1][place].append(float(np.mean(np.abs(milli / 1000.0 - pip))))
                pressures[-1][place].append(milli.tolist())
                commands[-1][place].append(np.round(10.0 * u_in).astype(int).tolist())
                peak = max(peak, max(float(np.max(row.pressure)) for row in run))
                passed &= bool(np.all(passes_safety_gate(inspired, pip, protocol.DT)))
        safe.append(passed)
        peaks.append(round(peak, 3))
    return {
        "errors": errors,
        "trace": {"pressure_milli_cmH2O": pressures, "u_in_tenths_percent": commands},
        "stops": stops,
        "safe": safe,
        "peak_pressure_cmH2O": peaks,
    }


def _skipped(logged: list[dict[str, Any]], lungs: list[str]) -> dict[str, list[str]]:
    """Parts of the self-test that were left out on each lung, at any of its mountings."""
    tests = [line for line in logged if line["type"] == "selftest" and line.get("go", True)]
    return {
        lung: sorted({part for line in tests if line["lung"] == lung for part in line["skipped"]})
        for lung in lungs
    }


def _control(log: Path) -> dict[str, Any]:
    """Errors of the PID between the scored runs, by lung, and their drift.

    The drift is the slope of a line through them in their order, from the first to the last,
    cmH2O; beside it stands its standard error.
    """
    by_lung: dict[str, list[float]] = {}
    for line in lines(log):
        complete = line["type"] == "run" and line["status"] == "complete"
        if complete and line["entry"] == CONTROL:
            by_lung.setdefault(line["lung"], []).append(line["error"])
    figures: dict[str, Any] = {}
    for lung, errors in by_lung.items():
        figures[lung] = {"errors": [round(error, 4) for error in errors]}
        if len(errors) >= 3:
            place = np.linspace(0.0, 1.0, len(errors))
            slope, offset = np.polyfit(place, errors, 1)
            residual = np.asarray(errors) - slope * place - offset
            variance = float(residual @ residual) / (len(errors) - 2)
            deviation = math.sqrt(variance / float(np.sum((place - place.mean()) ** 2)))
            figures[lung] |= {
                "drift": round(float(slope), 4),
                "standard_error": round(deviation, 4),
            }
    return figures


def save(folder: Path, content: bytes) -> Path:
    """Write a record, named by its hash; returns its path, for ``ventbench board add``."""
    path = folder / f"{canonical.digest(content)}{record.SUFFIX}"
    files.write_atomically(path, lambda file: file.write(content))
    return path
