"""A session read again from its raw log: its breaths in order, its timing, its record checked.

The breaths behind a record serve to compare simulators with the lung, too: these get the recorded
commands, and what they then do otherwise is the mismatch, whatever the controller did.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.loop import BreathLog
from hardware_eval.bench.plan import PlannedRun, progress
from hardware_eval.bench.raw_log import LoggedBreath, breaths, lines, recording
from hardware_eval.results.evaluate import LOG, UNDISTURBED
from hardware_eval.results.record import Jitter, jitter, plan_of
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import record as records
from ventbench.board.record import HardwareRecord
from ventbench.plants.catalog import load_simulators
from ventbench.plants.simulators import Simulators
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.read import load
from ventbench.task import protocol, waveform


@dataclass(frozen=True)
class Replay:
    """What a log says."""

    runs: int  #: runs of the plan.
    done: int  #: those that need not run again.
    breaths: int  #: breaths in the log, of all attempts.
    timing: Jitter  #: statistics of the loop.
    problems: tuple[str, ...]  #: where the record and the log differ; empty without a record.

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return files.json_values({**vars(self), "timing": dataclasses.asdict(self.timing)})

    def __str__(self) -> str:
        timing = self.timing
        rows = (
            f"{self.done} of {self.runs} runs are done, {self.breaths} breaths logged",
            f"{timing.steps} steps, {100 * timing.on_time:.2f} % within 2 ms, latest "
            f"{1e3 * timing.worst:.1f} ms, {timing.lost} lost, {timing.late_answers} late answers "
            f"({100 * timing.late_share:.2f} %), longest {1e3 * timing.longest_answer:.1f} ms, "
            f"{timing.outside} outside the envelope; fallback {100 * timing.fallback_share:.2f} % "
            f"of steps, at most {timing.longest_fallback} in a row",
        )
        return "\n".join([*rows, *self.problems])


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
    log = log / LOG if log.is_dir() else log
    logged = list(lines(log))
    plan = plan_of(logged, str(log))
    everything = breaths(log)
    _show(everything, rerun, mcap, len(plan.runs))
    problems = () if record is None else tuple(_differences(record, log, everything))
    done = len(progress(plan, logged).done)
    timing = jitter(log)
    return Replay(len(plan.runs), done, len(everything), timing, problems)


def _show(everything: list[LoggedBreath], rerun: str | None, mcap: Path | None, total: int) -> None:
    from hardware_eval.bench.console import McapView, RerunView

    written = McapView(mcap) if mcap else None
    shows = [RerunView(rerun).breath] if rerun else []
    shows += [written.breath] if written else []
    for breath in everything if shows else ():
        names = ("run", "kind", "entry", "lung", "pip", "repeat")
        run = PlannedRun(*(getattr(breath, name) for name in names))
        aims = waveform.target(np.arange(len(breath.time)), breath.pip)
        names = ("time", "pressure", "flow", "requested", "u_in", "u_out", "late")
        columns = {name: getattr(breath, name).tolist() for name in names}
        for show in shows:
            show(run, BreathLog(**columns, target=aims.tolist()), breath.run, total)
    if written:
        written.close()


def _differences(path: Path, log: Path, everything: list[LoggedBreath]) -> list[str]:
    """Where a record says something else than the log and its breaths."""
    loaded = records.load(path)
    if not isinstance(loaded, HardwareRecord):
        raise InputError(f"{path} is not a hardware record")
    cells, problems = _errors(everything), []
    if files.sha256(log) != loaded.header.recording.sha256:
        problems.append(f"{log} is not the recording that the record names by its hash")
    for i, lung in enumerate(loaded.header.lungs):
        for j, pip in enumerate(loaded.header.pips):
            own = np.array(sorted(cells.get((loaded.name, lung, pip), [])))
            said = loaded.errors[i, j]
            said = np.sort(said[np.isfinite(said)])
            if own.shape != said.shape or np.any(np.abs(own - said) > 0.001):
                problems.append(f"{lung}, PIP {pip:g}: the log gives other errors than the record")
    return problems


def _errors(everything: list[LoggedBreath]) -> dict[tuple[str, str, float], list[float]]:
    """Errors of the complete scored runs by entry, lung and PIP, cmH2O."""
    cells: dict[tuple[str, str, float], list[float]] = {}
    by_run: dict[tuple[int, int], list[LoggedBreath]] = {}
    for breath in everything:
        by_run.setdefault((breath.run, breath.attempt), []).append(breath)
    for run in by_run.values():
        first = run[0]
        if not first.complete or first.kind != "scored":
            continue
        inspired = np.stack(
            [run[k].pressure[: protocol.INSPIRATION_STEPS] for k in protocol.SCORED_BREATHS]
        )
        error = float(np.mean(np.abs(inspired - first.pip)))
        cells.setdefault((first.entry, first.lung, first.pip), []).append(error)
    return cells


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


def recorded_breaths(path: Path, log: Path | None = None) -> Breaths:
    """The breaths behind a hardware record, a log, a session's folder or a recording.

    The raw log that a record names is looked for beside it if it is not given.

    Raises:
        InputError: if the log is not there, or not the one that the record names.
    """
    if path.is_dir():
        path = path / LOG
    if path.name.endswith(".jsonl"):
        return recording(path, kinds=(*UNDISTURBED, "explore"))
    if not path.name.endswith(".json"):
        return load(path)
    loaded = records.load(path)
    if not isinstance(loaded, HardwareRecord):
        raise InputError(f"{path} is not a hardware record")
    log = log or path.parent / LOG
    if not log.is_file():
        raise InputError(f"{log} is not there: give --log FILE, the raw recording of {path}")
    if files.sha256(log) != loaded.header.recording.sha256:
        raise InputError(f"{log} is not the raw recording that {path} names by its hash")
    return recording(log, kinds=UNDISTURBED)
