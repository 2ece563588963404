"""Where the frozen simulators and a lung part: open-loop distance by lung and waveform, diagnosis.

The simulators get the recorded commands from the recorded start of each breath. What they then do
otherwise than the lung is the mismatch, whatever the controller did; :mod:`ventbench.diagnosis`
says which physics it looks like.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hardware_eval.bench.raw_log import recording
from hardware_eval.results.evaluate import LOG
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import record as records
from ventbench.board.record import HardwareRecord
from ventbench.plants.catalog import load_simulators
from ventbench.plants.simulators import Simulators
from ventbench.recordings.breaths import Breaths, join
from ventbench.recordings.read import load
from ventbench.task.metrics.open_loop import by_horizon, distance, mae

if TYPE_CHECKING:
    from ventbench.diagnosis.result import Diagnosis

Floats = NDArray[np.float64]

#: A waveform is told by its plateau: the mean pressure of the last third of the inspiration falls
#: into one of these, cmH2O.
_PLATEAUS = (0.0, 12.5, 17.5, 22.5, 27.5, 32.5, float("inf"))
_NAMES = (
    "up to 12.5",
    "12.5 to 17.5",
    "17.5 to 22.5",
    "22.5 to 27.5",
    "27.5 to 32.5",
    "above 32.5",
)


@dataclass(frozen=True)
class Distance:
    """Open-loop distance of some breaths; inspirations only.

    Attributes:
        breaths: how many.
        distance: sum of |simulated - recorded| over the steps of a breath, mean over breaths, cmH2O
            (the paper's distance).
        mae: mean of it per step, cmH2O.
        bias: mean of recorded minus simulated, cmH2O.
    """

    breaths: int
    distance: float
    mae: float
    bias: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """Simulators against a recording.

    Attributes:
        breaths: the recording.
        simulator: name of the simulators.
        lungs: distance by lung.
        waveforms: distance by lung, then by plateau pressure, cmH2O.
        horizon: mean absolute error at each step after the start by lung, cmH2O.
        diagnoses: by lung; empty if none was asked for.
    """

    breaths: Breaths
    simulator: str
    lungs: dict[str, Distance]
    waveforms: dict[str, dict[str, Distance]]
    horizon: dict[str, list[float]]
    diagnoses: Mapping[str, Diagnosis]

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return files.json_values(
            {
                "simulator": self.simulator,
                "unit": "cmH2O",
                "lungs": {name: vars(value) for name, value in self.lungs.items()},
                "waveforms": {
                    name: {key: vars(value) for key, value in rows.items()}
                    for name, rows in self.waveforms.items()
                },
                "horizon": self.horizon,
                "diagnoses": {name: value.as_dict() for name, value in self.diagnoses.items()},
            }
        )

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
    breaths: Breaths,
    *,
    simulator: Any = "frozen",
    diagnose: bool = True,
    progress: Callable[[str, float], None] | None = None,
) -> Comparison:
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


def _plateaus(breaths: Breaths) -> NDArray[np.int64]:
    inspired = np.where(breaths.inspiratory, breaths.pressure, np.nan)
    last = np.sum(breaths.inspiratory, axis=1)
    steps = np.arange(breaths.pressure.shape[1])
    late = np.where(steps >= (2 * last // 3)[:, None], inspired, np.nan)
    return np.searchsorted(_PLATEAUS, np.nanmean(late, axis=1)) - 1


def _distance(breaths: Breaths, simulated: Floats, index: NDArray[np.int64]) -> Distance:
    mask = breaths.inspiratory[index]
    measured, answer = breaths.pressure[index], simulated[index]
    difference = np.where(mask, measured - answer, np.nan)[:, 1:]
    return Distance(
        int(index.size),
        float(np.mean(distance(measured, answer, mask))),
        float(np.mean(mae(measured, answer, mask))),
        float(np.nanmean(difference)),
    )


def recorded_breaths(path: Path, log: Path | None = None) -> Breaths:
    """The breaths behind a hardware record, a log, a session's folder or a recording.

    Args:
        path: of the record, the log, the folder or a file in the public schema.
        log: the raw log that a record names; looked for beside the record if not given.

    Raises:
        InputError: if the log is not there, or not the one that the record names.
    """
    if path.is_dir():
        return recording(path / LOG)
    if path.name.endswith(".jsonl"):
        return recording(path)
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
    return recording(log, kinds=("ramp", "scored", "control"))


def joined(parts: list[Breaths]) -> Breaths:
    """Recordings as one, with breaths numbered anew."""
    together = join(parts)
    return replace(together, breath_id=np.arange(len(together)) + 1)
