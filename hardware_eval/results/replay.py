"""A session again, from its raw log: breaths in order, errors and timing computed anew."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.bench.loop import BreathLog
from hardware_eval.bench.plan import PlannedRun, progress
from hardware_eval.bench.raw_log import breaths, lines
from hardware_eval.results.evaluate import LOG
from hardware_eval.results.record import Jitter, jitter, plan_of
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import record as records
from ventbench.board.record import HardwareRecord
from ventbench.task import protocol, waveform


@dataclass(frozen=True)
class Replay:
    """What a log says.

    Attributes:
        runs: runs of the plan.
        done: those that need not run again.
        breaths: breaths in the log, of all attempts.
        errors: mean error of the complete scored runs by entry and lung, cmH2O.
        spreads: standard deviation of the runs of one cell, pooled, cmH2O; NaN for one repetition.
        timing: statistics of the loop.
        problems: where the record and the log differ; empty without a record.
    """

    runs: int
    done: int
    breaths: int
    errors: dict[str, dict[str, float]]
    spreads: dict[str, dict[str, float]]
    timing: Jitter
    problems: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return files.json_values({**vars(self), "timing": dataclasses.asdict(self.timing)})

    def __str__(self) -> str:
        timing = self.timing
        rows = [f"{self.done} of {self.runs} runs are done, {self.breaths} breaths logged"]
        for entry, by_lung in self.errors.items():
            cells = ", ".join(f"{lung} {error:.3f}" for lung, error in by_lung.items())
            rows.append(f"{entry}: {cells} cmH2O")
        rows.append(
            f"{timing.steps} steps, {100 * timing.on_time:.2f} % within 2 ms, latest "
            f"{1e3 * timing.worst:.1f} ms, {timing.lost} lost, {timing.late_answers} late answers "
            f"({100 * timing.late_share:.2f} %), longest {1e3 * timing.longest_answer:.1f} ms"
        )
        return "\n".join([*rows, *self.problems])


def replay(log: Path, *, record: Path | None = None, rerun: str | None = None) -> Replay:
    """Read a log again.

    Args:
        log: the file, or the folder that holds it.
        record: a hardware record to check against it.
        rerun: ``"live"`` or the path of an ``.rrd`` file to show the breaths in.

    Raises:
        InputError: if there is no such log, or the record is none.
    """
    log = log / LOG if log.is_dir() else log
    logged = list(lines(log))
    plan = plan_of(logged, str(log))
    cells: dict[tuple[str, str, float], list[float]] = {}
    everything = breaths(log)
    by_run: dict[tuple[int, int], list[Any]] = {}
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
    errors: dict[str, dict[str, float]] = {}
    spreads: dict[str, dict[str, float]] = {}
    for entry in plan.entries:
        for lung in plan.lungs:
            own = [values for key, values in cells.items() if key[:2] == (entry, lung)]
            if own:
                errors.setdefault(entry, {})[lung] = float(np.mean([np.mean(x) for x in own]))
                variances = [np.var(x, ddof=1) for x in own if len(x) > 1]
                spread = float(np.sqrt(np.mean(variances))) if variances else float("nan")
                spreads.setdefault(entry, {})[lung] = spread
    if rerun is not None:
        _show(everything, rerun, len(plan.runs))
    problems = () if record is None else tuple(_differences(record, log, cells))
    done = len(progress(plan, logged).done)
    timing = jitter(log)
    return Replay(len(plan.runs), done, len(everything), errors, spreads, timing, problems)


def _show(everything: list[Any], target: str, total: int) -> None:
    from hardware_eval.bench.console import RerunView

    view = RerunView(target)
    for breath in everything:
        run = PlannedRun(
            breath.run, breath.kind, breath.entry, breath.lung, breath.pip, breath.repeat
        )
        aims = waveform.target(np.arange(len(breath.time)), breath.pip)
        columns = {
            name: getattr(breath, name).tolist()
            for name in ("time", "pressure", "flow", "requested", "u_in", "late")
        }
        log = BreathLog(**columns, u_out=breath.u_out.tolist(), target=aims.tolist())
        view.breath(run, log, breath.run, total)


def _differences(
    path: Path, log: Path, cells: dict[tuple[str, str, float], list[float]]
) -> list[str]:
    """Where a record says something else than the log."""
    loaded = records.load(path)
    if not isinstance(loaded, HardwareRecord):
        raise InputError(f"{path} is not a hardware record")
    problems = []
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
