"""Where the frozen simulators and a lung part: open-loop distance by lung and waveform, diagnosis.

The simulators get the recorded commands from the recorded start of each breath. What they then do
otherwise than the lung is the mismatch, whatever the controller did; :mod:`ventbench.diagnosis`
says which physics it looks like.

A session can be had again from its raw log: breaths in order, errors and timing computed anew.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hardware_eval.bench.loop import BreathLog
from hardware_eval.bench.plan import PlannedRun, progress
from hardware_eval.bench.raw_log import breaths, lines, recording
from hardware_eval.results.evaluate import LOG, UNDISTURBED
from hardware_eval.results.record import Jitter, jitter, plan_of
from ventbench.base import files
from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.board import record as records
from ventbench.board.record import HardwareRecord
from ventbench.plants.catalog import load_simulators
from ventbench.plants.simulators import Simulators
from ventbench.recordings.breaths import Breaths, join
from ventbench.recordings.read import load
from ventbench.task import protocol, waveform
from ventbench.task.metrics.open_loop import by_horizon, distance, mae

if TYPE_CHECKING:
    from ventbench.diagnosis.result import Diagnosis


@dataclass(frozen=True)
class Replay:
    """What a log says."""

    runs: int  #: runs of the plan.
    done: int  #: those that need not run again.
    breaths: int  #: breaths in the log, of all attempts.
    #: mean error of the complete scored runs by entry and lung, cmH2O.
    errors: dict[str, dict[str, float]]
    #: standard deviation of the runs of one cell, pooled, cmH2O; NaN for one repetition.
    spreads: dict[str, dict[str, float]]
    timing: Jitter  #: statistics of the loop.
    problems: tuple[str, ...]  #: where the record and the log differ; empty without a record.

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
            f"({100 * timing.late_share:.2f} %), longest {1e3 * timing.longest_answer:.1f} ms, "
            f"{timing.outside} outside the envelope; fallback {100 * timing.fallback_share:.2f} % "
            f"of steps, at most {timing.longest_fallback} in a row"
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
    _show(everything, rerun, mcap, len(plan.runs))
    problems = () if record is None else tuple(_differences(record, log, cells))
    done = len(progress(plan, logged).done)
    timing = jitter(log)
    return Replay(len(plan.runs), done, len(everything), errors, spreads, timing, problems)


def _show(everything: list[Any], rerun: str | None, mcap: Path | None, total: int) -> None:
    from hardware_eval.bench.console import McapView, RerunView, Views

    shown = [*([RerunView(rerun)] if rerun else []), *([McapView(mcap)] if mcap else [])]
    if not shown:
        return
    view = Views(*shown)
    for breath in everything:
        names = ("run", "kind", "entry", "lung", "pip", "repeat")
        run = PlannedRun(*(getattr(breath, name) for name in names))
        aims = waveform.target(np.arange(len(breath.time)), breath.pip)
        names = ("time", "pressure", "flow", "requested", "u_in", "u_out", "late")
        columns = {name: getattr(breath, name).tolist() for name in names}
        view.breath(run, BreathLog(**columns, target=aims.tolist()), breath.run, total)
    view.close()


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


#: A waveform is told by its plateau: the mean pressure of the last third of the inspiration falls
#: into one of these, cmH2O.
_PLATEAUS = (0.0, 12.5, 17.5, 22.5, 27.5, 32.5, float("inf"))
_NAMES = (
    "up to 12.5", "12.5 to 17.5", "17.5 to 22.5", "22.5 to 27.5", "27.5 to 32.5", "above 32.5",
)  # fmt: skip


@dataclass(frozen=True)
class Distance:
    """Open-loop distance of some breaths; inspirations only."""

    breaths: int  #: how many.
    #: sum of |simulated - recorded| over the steps of a breath, mean over breaths, cmH2O (the
    #: paper's distance).
    distance: float
    mae: float  #: mean of it per step, cmH2O.
    bias: float  #: mean of recorded minus simulated, cmH2O.


@dataclass(frozen=True, eq=False)
class Comparison:
    """Simulators against a recording."""

    breaths: Breaths  #: the recording.
    simulator: str  #: name of the simulators.
    lungs: dict[str, Distance]  #: distance by lung.
    waveforms: dict[str, dict[str, Distance]]  #: distance by lung, then by plateau pressure, cmH2O.
    #: mean absolute error at each step after the start by lung, cmH2O.
    horizon: dict[str, list[float]]
    diagnoses: Mapping[str, Diagnosis]  #: by lung; empty if none was asked for.

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        plain = {
            name: {key: vars(value) for key, value in rows.items()}
            for name, rows in {"": self.lungs, **self.waveforms}.items()
        }
        return files.json_values({
            "simulator": self.simulator, "unit": "cmH2O", "lungs": plain.pop(""),
            "waveforms": plain, "horizon": self.horizon,
            "diagnoses": {name: value.as_dict() for name, value in self.diagnoses.items()},
        })  # fmt: skip

    def __str__(self) -> str:
        rows = [f"open-loop distance of the {self.simulator} simulators, inspirations, cmH2O"]
        for lung, whole in self.lungs.items():
            rows.append(
                f"  {lung}: {whole.distance:.1f} a breath, {whole.mae:.2f} a step, bias "
                f"{whole.bias:+.2f} ({whole.breaths} breaths)"
            )
            rows += [
                f"    plateau {name} cmH2O: {part.mae:.2f} a step, bias {part.bias:+.2f} "
                f"({part.breaths})"
                for name, part in self.waveforms[lung].items()
            ]
        for lung, diagnosis in self.diagnoses.items():
            rows += [f"{lung}: {line}" for line in str(diagnosis).splitlines()]
        return "\n".join(rows)


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


def compare(
    breaths: Breaths, *, simulator: Any = "frozen", diagnose: bool = True,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:  # fmt: skip
    """Compare simulators with a recording.

    Args:
        breaths: the recording.
        simulator: whatever :func:`ventbench.load_simulators` takes.
        diagnose: also say which physics the mismatch looks like; takes tens of seconds a lung.
        progress: receives the diagnosis's current step in words, and the share that is done.

    Raises:
        InputError: if there is no simulator for a lung, or too few breaths for a diagnosis.
    """
    lungs = list(breaths.by_lung_index)
    tested = scored_plants(simulator, lungs)
    simulated = tested.pressures(breaths)
    whole, waveforms, horizon = {}, {}, {}
    for lung, index in breaths.by_lung_index.items():
        whole[lung] = _distance(breaths, simulated, index)
        plateaus = _plateaus(breaths)
        waveforms[lung] = {
            name: _distance(breaths, simulated, part)
            for k, name in enumerate(_NAMES)
            if (part := index[plateaus[index] == k]).size
        }
        mask = breaths.inspiratory[index]
        steps = by_horizon(breaths.pressure[index], simulated[index], mask)
        horizon[lung] = [round(float(x), 4) for x in steps if np.isfinite(x)]
    diagnoses = {}
    if diagnose:
        from ventbench.diagnosis.diagnose import diagnose as run_diagnosis

        for lung in lungs:
            diagnoses[lung] = run_diagnosis(breaths, simulator=tested, lung=lung, progress=progress)
    return Comparison(breaths, tested.name, whole, waveforms, horizon, diagnoses)


def _plateaus(breaths: Breaths) -> Ints:
    inspired = np.where(breaths.inspiratory, breaths.pressure, np.nan)
    last = np.sum(breaths.inspiratory, axis=1)
    steps = np.arange(breaths.pressure.shape[1])
    late = np.where(steps >= (2 * last // 3)[:, None], inspired, np.nan)
    return np.searchsorted(_PLATEAUS, np.nanmean(late, axis=1)) - 1


def _distance(breaths: Breaths, simulated: Floats, index: Ints) -> Distance:
    mask = breaths.inspiratory[index]
    measured, answer = breaths.pressure[index], simulated[index]
    difference = np.where(mask, measured - answer, np.nan)[:, 1:]
    sums, means = (np.mean(of(measured, answer, mask)) for of in (distance, mae))
    return Distance(int(index.size), float(sums), float(means), float(np.nanmean(difference)))


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


def joined(parts: list[Breaths]) -> Breaths:
    """Recordings as one, with breaths numbered anew."""
    together = join(parts)
    return replace(together, breath_id=np.arange(len(together)) + 1)
