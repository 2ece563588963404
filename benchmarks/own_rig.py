"""A rig of one's own, end to end: recordings, simulators, what is missing, a better controller.

The rig is emulated, so that there is a truth to test against: a lung of 12 cmH2O/(L/s) and
30 mL/cmH2O whose inspiratory valve answers late and slowly and gives less than its data sheet says.
Nobody is told. The steps are those that a laboratory would take:

1. record breaths with the paper's exploration (``recordings/rig.csv``, public schema);
2. take the simulator that one would have without recordings: an R-C lung at its label;
3. diagnose it (``ventbench diagnose``), which gives ``corrected.json``;
4. learn a simulator from the recordings alone (``ventbench train simulator``);
5. tune a PID on each (``ventbench tune pid``), and run all of them on the rig.

Usage: ``python benchmarks/own_rig.py [--out DIR] [--breaths N] [--iterations N] [--json FILE]``
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from ventbench import files, recordings
from ventbench.diagnosis.diagnose import diagnose
from ventbench.interfaces import Plant
from ventbench.lungs import lung
from ventbench.physics import physics
from ventbench.training import pid_grid
from ventbench.training.exploration import ExplorationRanges, SimulatedVentilator, explore
from ventbench.training.rigs.fit import FitConfig
from ventbench.training.rigs.train import RigConfig, train_rigs

#: Label of the lung, which is true; no simulator of ours was made for it.
LUNG = "R12C30"

#: What nobody is told: dead time and lag of the valve, and its gain, mL/s per %.
MISSING = {"valve_delay": {"delay": 0.045}, "valve_lag": {"tau": 0.05}}
GAIN = 19.0

#: Noise of the sensor, cmH2O.
NOISE = 0.2

#: Exploration: that of the paper for R20C20, with a gentle PID.
RANGES = ExplorationRanges((0.5, 2.0, 0.0), (30.0, 60.0), (0.5, 1.0), (-20.0, 40.0))


def rig() -> Plant:
    """Return the emulated rig."""
    return physics(lung(LUNG), MISSING, gain=GAIN)


def record(path: Path, breaths: int, seed: int = 0) -> recordings.Breaths:
    """Explore the rig and write the recording."""
    ventilator = SimulatedVentilator(rig(), width=4, noise=NOISE, seed=seed)
    made = explore(ventilator, LUNG, breaths, seed=seed, ranges=RANGES)
    recordings.write(made, path)
    return recordings.load(path)


def gains() -> np.ndarray:
    """Return the paper's gains without derivative part, %/cmH2O, shape ``(400, 3)``."""
    grid = pid_grid.paper_gains()
    return grid[grid[:, 2] == 0.0]


def tuned(simulator: Any) -> tuple[tuple[float, ...], float]:
    """Best gains on a simulator, and the error that it promises, cmH2O."""
    grid, _ = pid_grid.tune_pid([LUNG], simulator=simulator, gains=gains(), single=False)
    return grid.best(LUNG)


def on_the_rig(best: tuple[float, ...]) -> float:
    """Error of a PID on the rig itself, cmH2O."""
    grid, _ = pid_grid.tune_pid([LUNG], simulator={LUNG: rig()}, gains=[best], single=False)
    return grid.best(LUNG)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("runs/own_rig"))
    parser.add_argument("--breaths", type=int, default=36)
    parser.add_argument("--iterations", type=int, default=240)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folder = options.out / "recordings"
    folder.mkdir(parents=True, exist_ok=True)
    breaths = record(folder / "rig.csv", options.breaths)
    print(f"recorded {len(breaths)} breaths")

    diagnosis = diagnose(breaths, simulator="physics")
    diagnosis.save(options.out / "diagnosis")
    print(f"missing: {diagnosis.mechanisms}")
    config = RigConfig(resamples=2, fit=FitConfig(iterations=options.iterations))
    train_rigs(folder, options.out / "learned", config=config)

    simulators: dict[str, Any] = {
        "physics at the label": "physics",
        "corrected": options.out / "diagnosis" / "corrected.json",
        "learned from the recordings": options.out / "learned",
        "the rig itself": {LUNG: rig()},
    }
    result = {}
    print(f"{'PID tuned on':30} {'P, I':>12} {'promised':>9} {'on the rig':>11}  cmH2O")
    for name, simulator in simulators.items():
        best, promised = tuned(simulator)
        real = on_the_rig(best)
        result[name] = {"gains": list(best), "promised": promised, "on_the_rig": real}
        print(f"{name:30} {f'{best[0]:g}, {best[1]:g}':>12} {promised:9.3f} {real:11.3f}")
    if options.json is not None:
        files.write_json(options.json, result)


if __name__ == "__main__":
    main()
