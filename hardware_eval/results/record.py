"""From the log of a plan to the hardware records of its entries; and both read again.

The record holds the measured pressures of every scored inspiration, from which the score follows,
and names the raw log by its hash. ``ventbench board add`` takes it.

The breaths behind a record serve to compare simulators with the lung, too: these get the recorded
commands, and what they then do otherwise is the mismatch, whatever the controller did.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.console import show_in_rerun, write_mcap
from hardware_eval.bench.loop import ON_TIME_S, BreathLog
from hardware_eval.bench.plan import CONTROL, UNDISTURBED
from hardware_eval.bench.raw_log import (
    LOG,
    Session,
    log_of,
    read_session,
    recording,
)
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import canonical, create, record, schema
from ventbench.board.record import TRACK, HardwareRecord
from ventbench.entries.folder import Submission, combined_hash, file_hashes
from ventbench.plants.catalog import load_simulators
from ventbench.plants.simulators import Simulators
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.read import load
from ventbench.task import protocol
from ventbench.task.metrics import measured

#: Longest reason of a stopped run in a record, characters.
_REASON = 1000


def timing(session: Session, entry: str | None = None) -> dict[str, float]:
    """Statistics of all steps of a session; answers of one entry's runs, or of all.

    Returns:
        ``steps``, and those that began after the deadline of the next one (``lost``); the share
        that began within 2 ms of the deadline (``on_time``), and the latest (``worst``, s); answers
        that were asked for (``asked``), that came late (``late_answers``), their share
        (``late_share``), and the longest (``longest_answer``, s); answers that the fallback refused
        (``outside``), its share of the steps (``fallback_share``), and most in a row
        (``longest_fallback``); time from a step's beginning to its command's answer
        (``busy_median``, ``busy_worst``, s).

    Raises:
        InputError: if it holds no step.
    """
    late, busy = (
        np.array([x for line in session.of_type("breath") for x in line[name]], float)
        for name in ("late", "busy")
    )
    if not late.size:
        raise InputError(f"{session.path} holds no breath")
    runs = session.of_type("run", **({"entry": entry} if entry else {}))
    told = ("late_answers", "asked", "outside", "fallback", "longest_answer", "longest_fallback")
    answers = {name: [line.get(name, 0) for line in runs] or [0] for name in told}
    sums = {name: sum(counts) for name, counts in answers.items()}
    asked = max(sums["asked"], 1)
    return {
        "steps": len(late),
        "on_time": float(np.mean(late <= ON_TIME_S)),
        "lost": int(np.sum(late > protocol.DT)),
        "worst": float(late.max()),
        "asked": sums["asked"],
        "late_answers": sums["late_answers"],
        "late_share": sums["late_answers"] / asked,
        "outside": sums["outside"],
        "fallback_share": sums["fallback"] / asked,
        **{name: max(answers[name]) for name in told[-2:]},
        "busy_median": float(np.median(busy)),
        "busy_worst": float(np.max(busy)),
    }


def hardware_record(log: Path, submission: Submission) -> tuple[bytes, HardwareRecord]:
    """Make the hardware record of an entry, with the files that ran, from the log of a plan.

    Returns:
        Canonical JSON, and what the leaderboard reads of it.

    Raises:
        InputError: if the plan is not finished, the entry is not in it, or its files have changed.
    """
    session = read_session(log)
    plan, name = session.plan, submission.manifest.name
    if name not in plan.entries:
        raise InputError(f"{log} is of {', '.join(plan.entries)}, not of {name}")
    left = [run for run in session.left if run.entry == name]
    if left:
        raise InputError(
            f"{log}: {len(left)} runs of {name} are left; run the same command again, it continues"
        )
    about = session.about
    _check_same(session, name)
    hashes = file_hashes(submission.folder)
    if combined_hash(hashes) != submission.sha256 or submission.sha256 != about["entries"][name]:
        raise InputError(f"{submission.label} has changed since it ran; it needs a plan of its own")
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
        "lungs": session.lungs,
        "pips": list(plan.pips),
        "repeats": plan.repeats,
        **_tables(session, name),
        "recording": {
            "sha256": files.sha256(log),
            "bytes": log.stat().st_size,
            "breaths": len(session.breaths),
        },
        "plan": plan.as_dict(),
        "control": control(session),
        "safety": about["safety"],
        "selftest": _skipped(session),
        "timing": timing(session, name),
        "sandbox": about["sandbox"],
        "provenance": {},
        "versions": create.versions(),
        "machine": create.machine(),
    }
    made = canonical.canonical(canonical.through_json(content))
    checked = record.from_bytes(made, f"the hardware record of {name}")
    assert isinstance(checked, HardwareRecord)
    return made, checked


def _check_same(session: Session, name: str) -> None:
    """Refuse a log whose sessions were of other devices, calibrations or files of the entry."""
    log, sessions = session.path, session.of_type("session")
    for key in ("device", "safety", "sandbox"):
        if any(x[key] != sessions[0][key] for x in sessions):
            raise InputError(f"{log}: {key} changed between sessions; a record needs one of it")
    if len({x["entries"].get(name) for x in sessions}) > 1:
        raise InputError(f"{log}: the files of {name} changed between sessions")


def _tables(session: Session, name: str) -> dict[str, Any]:
    """Errors, traces, stops and safety of every cell of an entry."""
    plan = session.plan
    runs: dict[tuple[str, float, int], list[BreathLog]] = {}
    for breath in session.breaths:
        run = breath.run
        if run.entry == name and run.kind == "scored" and breath.complete:
            runs.setdefault((run.lung, run.pip, run.repeat), []).append(breath.log)
    failed = {
        (line["lung"], line["pip"], line["repeat"]): line["reason"]
        for line in session.of_type("run", status="failed", entry=name, kind="scored")
    }
    cells = list(product(session.lungs, plan.pips, range(1, plan.repeats + 1)))
    rows = [_cell(runs[cell], cell[1]) if cell in runs else _STOPPED for cell in cells]
    grid = np.array(rows).reshape(len(session.lungs), len(plan.pips), plan.repeats)

    def table(column: str) -> list[list[list[Any]]]:
        return [[[row[column] for row in cell] for cell in lung] for lung in grid]

    stops = [
        {"lung": cell[0], "pip": cell[1], "repeat": cell[2], "reason": reason[:_REASON]}
        for cell, reason in ((x, failed.get(x, "stopped")) for x in cells if x not in runs)
    ]
    peaks = [max(row["peak"] for row in lung.flat) for lung in grid]
    return {
        "errors": table("error"),
        "trace": {"pressure_milli_cmH2O": table("milli"), "u_in_tenths_percent": table("tenths")},
        "stops": stops,
        "safe": [all(row["safe"] for row in lung.flat) for lung in grid],
        "peak_pressure_cmH2O": [round(peak, 3) if math.isfinite(peak) else 0.0 for peak in peaks],
    }


#: What a record says of a run that failed.
_STOPPED = {"error": None, "milli": None, "tenths": None, "safe": False, "peak": -math.inf}


def _cell(breaths: list[BreathLog], pip: float) -> dict[str, Any]:
    """What a record says of a run that completed."""
    milli = np.round(1000.0 * measured.scored([breath.pressure for breath in breaths]))
    u_in = measured.scored([breath.u_in for breath in breaths])
    return {
        "error": measured.mean_error(milli / 1000.0, pip),
        "milli": [[None if math.isnan(x) else int(x) for x in row] for row in milli],
        "tenths": np.round(10.0 * u_in).astype(int).tolist(),
        "safe": all(measured.is_safe(breath.pressure, pip, protocol.DT) for breath in breaths),
        "peak": max(measured.highest(breath.pressure) for breath in breaths),
    }


def _skipped(session: Session) -> dict[str, list[str]]:
    """Parts of the self-test that were left out on each lung, at any of its mountings."""
    tests = [line for line in session.of_type("selftest") if line.get("go", True)]
    return {
        lung: sorted({part for line in tests if line["lung"] == lung for part in line["skipped"]})
        for lung in session.lungs
    }


def control(session: Session) -> dict[str, Any]:
    """Errors of the PID between the scored runs, by lung, and their drift.

    The drift is the slope of a line through them in their order, from the first to the last,
    cmH2O; beside it stands its standard error.
    """
    by_lung: dict[str, list[float]] = {}
    for line in session.ended:
        if (line["entry"], line["status"]) == (CONTROL, "complete"):
            by_lung.setdefault(line["lung"], []).append(line["error"])
    figures: dict[str, Any] = {}
    for lung, errors in by_lung.items():
        figures[lung] = {"errors": [round(error, 4) for error in errors]}
        if len(errors) >= 3:
            place = np.linspace(0.0, 1.0, len(errors))
            line, covariance = np.polyfit(place, errors, 1, cov=True)
            error = math.sqrt(covariance[0, 0])
            figures[lung] |= {"drift": round(float(line[0]), 4), "standard_error": round(error, 4)}
    return figures


def save(folder: Path, content: bytes) -> Path:
    """Write a record, named by its hash; returns its path, for ``ventbench board add``."""
    path = folder / f"{canonical.digest(content)}{record.SUFFIX}"
    files.write_bytes(path, content)
    return path


@dataclass(frozen=True)
class Replay:
    """What a log says."""

    runs: int  #: runs of the plan.
    done: int  #: those that need not run again.
    breaths: int  #: breaths in the log, of all attempts.
    timing: dict[str, float]  #: statistics of the loop, see :func:`timing`.
    problems: tuple[str, ...]  #: where the record and the log differ; empty without a record.

    def __str__(self) -> str:
        steps = (
            "{steps} steps, {on_time:.2%} within 2 ms, latest {worst:.4f} s, {lost} lost, "
            "{late_answers} late answers ({late_share:.2%}), longest {longest_answer:.4f} s, "
            "{outside} outside the envelope; fallback {fallback_share:.2%} of steps, at most "
            "{longest_fallback} in a row"
        )
        done = f"{self.done} of {self.runs} runs are done, {self.breaths} breaths logged"
        return "\n".join([done, steps.format(**self.timing), *self.problems])


def replay(
    log: Path, *, record: Path | None = None, rerun: str | None = None, mcap: Path | None = None
) -> Replay:
    """Read a log again.

    Args:
        log: the file, or the folder that holds it.
        record: a hardware record to check against it.
        rerun: ``"live"`` or the path of an ``.rrd`` file to show the breaths in.
        mcap: MCAP file to write them to.

    Raises:
        InputError: if there is no such log, or the record is none.
    """
    session = read_session(log)
    runs, everything = len(session.plan.runs), session.breaths
    if rerun:
        show = show_in_rerun(rerun)
        for breath in everything:
            show(breath.run, breath.log, breath.run.number, runs)
    if mcap:
        write_mcap(mcap, everything)
    problems = () if record is None else tuple(_differences(record, session))
    return Replay(runs, runs - len(session.left), len(everything), timing(session), problems)


def _differences(path: Path, session: Session) -> list[str]:
    """Where a record says something else than the log."""
    loaded, problems = _loaded(path), []
    if files.sha256(session.path) != loaded.header.recording.sha256:
        problems.append(f"{session.path} is not the recording that the record names by its hash")
    lungs = [*loaded.header.lungs]
    if lungs != session.lungs:
        return [*problems, f"the log is of {', '.join(session.lungs)}"]
    errors = np.array(_tables(session, loaded.name)["errors"], float)
    for lung, own, said in zip(lungs, errors, loaded.errors, strict=True):
        if own.shape != said.shape or not np.allclose(own, said, 0.0, 1e-3, equal_nan=True):
            problems.append(f"{lung}: the log gives other errors than the record")
    return problems


def _loaded(path: Path) -> HardwareRecord:
    loaded = record.load(path)
    if not isinstance(loaded, HardwareRecord):
        raise InputError(f"{path} is not a hardware record")
    return loaded


def scored_plants(simulator: Any, lungs: list[str]) -> Simulators:
    """The plants that entries are scored on, by lung.

    By name the frozen simulators choose a rig by the clock of a recording; one of exactly 30 ms
    tells none, and what matters here is the rig that scores.
    """
    simulators = load_simulators(simulator)
    if not simulators.has_plants:
        return simulators
    plants = load_simulators({lung: simulators.plant(lung) for lung in lungs})
    return replace(plants, name=simulators.name)


def recorded_breaths(path: Path) -> Breaths:
    """The breaths behind a hardware record, a log, a session's folder or a recording.

    The raw log that a record names must lie beside it.

    Raises:
        InputError: if the log is not there, or not the one that the record names.
    """
    if path.is_dir():
        path = log_of(path)
    if path.name.endswith(".jsonl"):
        return recording(path, kinds=(*UNDISTURBED, "explore"))
    if not path.name.endswith(".json"):
        return load(path)
    loaded, log = _loaded(path), path.parent / LOG
    if not log.is_file():
        raise InputError(f"{log} is not there: put the raw recording of {path} beside it")
    if files.sha256(log) != loaded.header.recording.sha256:
        raise InputError(f"{log} is not the raw recording that {path} names by its hash")
    return recording(log, kinds=UNDISTURBED)
