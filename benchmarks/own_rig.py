"""A rig of one's own, end to end: recordings, what a simulator lacks, a better controller.

The rig is emulated, so that there is a truth to test against: a lung whose label is right, behind
a valve that nobody has looked at. The steps are those that a laboratory would take:

1. record breaths with the paper's exploration (``recordings/rig.csv``, public schema);
2. take the simulator that one would have without recordings: an R-C lung at its label;
3. diagnose it (``ventbench diagnose``), which gives ``corrected.json``;
4. learn a simulator from the recordings alone (``ventbench train simulator``);
5. train the same controllers on each (``ventbench train pid``, ``submissions/residual_mlp``),
   and run all of them on the rig, under noise and deviations that are the same for all.

Usage: ``python benchmarks/own_rig.py [--out DIR] [--rig NAME]``.
Diagnosis, simulators and each training are kept in ``--out`` when they are finished, so that the
same command continues.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import typer

from submissions.residual_mlp import train as residual_mlp
from ventbench import recordings
from ventbench.base import compilation
from ventbench.base.arrays import Floats
from ventbench.base.resume import WorkFolder
from ventbench.controllers.pid import PID
from ventbench.diagnosis.diagnose import diagnose
from ventbench.physics import physics
from ventbench.task import draws, protocol, rollouts
from ventbench.task.environment import nominal_scenario
from ventbench.task.interfaces import Controller, Plant
from ventbench.task.lungs import lung
from ventbench.task.metrics.score import run_error
from ventbench.train import pid_search
from ventbench.train.exploration import ExplorationRanges, SimulatedVentilator, explore
from ventbench.train.rigs.fit import FitConfig
from ventbench.train.rigs.train import RigConfig, train_rigs

#: Label of the lung, which is true; no simulator of ours was made for it.
LUNG = "R12C30"

#: Noise of the sensor, cmH2O.
NOISE = 0.2

#: Exploration: that of the paper for R20C20, with a gentle PID.
RANGES = ExplorationRanges((0.5, 2.0, 0.0), (30.0, 60.0), (0.5, 1.0), (-20.0, 40.0))


@dataclass(frozen=True)
class Concealed:
    """What nobody is told of a rig.

    Attributes:
        words: what it is, for the page.
        mechanisms: mechanisms and their parameters.
        gain: of the valve, mL/s per %; 22.8 by its data sheet.
    """

    words: str
    mechanisms: Mapping[str, Mapping[str, float]]
    gain: float = 22.8


#: Rigs to choose from. Strengths lie between *mild* and *strong* of the library.
RIGS = {
    "late": Concealed(
        "a valve that answers 60 ms late and a sensor behind a filter of 80 ms",
        {"valve_delay": {"delay": 0.06}, "sensor_lag": {"tau": 0.08}},
    ),
    "leak": Concealed("a leak of 15 mL/s at 1 cmH2O", {"leak": {"conductance": 15.0}}),
    "droop": Concealed(
        "a valve that loses 40 % of its flow towards 100 %", {"valve_curve": {"loss": 0.4}}
    ),
}

#: What the controllers are trained on, in the order of the table.
SIMULATORS = ("R-C lung at the label", "corrected", "learned", "the rig itself")


def rig_of(concealed: Concealed) -> Plant:
    """Return an emulated rig."""
    return physics(lung(LUNG), concealed.mechanisms, gain=concealed.gain)


def record(plant: Plant, path: Path, breaths: int, seed: int = 0) -> recordings.Breaths:
    """Explore the rig and write the recording."""
    ventilator = SimulatedVentilator(plant, width=4, noise=NOISE, seed=seed)
    made = explore(ventilator, LUNG, breaths, seed=seed, ranges=RANGES)
    recordings.write(made, path)
    return recordings.load(path)


def gains() -> Floats:
    """Return the paper's gains without derivative part, %/cmH2O, shape ``(400, 3)``."""
    grid = pid_search.paper_gains()
    return grid[grid[:, 2] == 0.0]


def errors(controller: Controller, plant: Plant) -> tuple[float, Floats]:
    """Error without noise, cmH2O, and that of each of the 20 draws, shape ``(20,)``."""
    with compilation.float64():
        plant = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), plant)
        controller = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), controller)
        out = []
        drawn = jax.tree.map(lambda x: jnp.asarray(x[0]), draws.build([[0]], 1).cells)
        for cells in (nominal_scenario(np.asarray(protocol.PIPS)), drawn):
            cells = jax.tree.map(jnp.asarray, cells)
            run, _ = rollouts.closed_loop(plant, controller, cells)
            out.append(run_error(run.pressure, np.asarray(cells.pip)[..., None, None]))
    return float(out[0].mean()), out[1].mean(axis=-1)


def tuned_on(simulator: Any, plant: Plant) -> dict[str, Any]:
    """Tune a PID on a simulator, and run it on the rig.

    Returns:
        Gains, and errors on the simulator (``promised``) and on the rig, cmH2O.
    """
    grid, _ = pid_search.tune_pid([LUNG], simulator=simulator, gains=gains(), draws=0)
    best, promised = grid.best(LUNG)
    nominal, drawn = errors(PID(*best), plant)
    return {"gains": list(best), "promised": promised, "rig": nominal, "draws": drawn.tolist()}


def trained_on(
    simulator: Any, best: Sequence[float], plant: Plant, out: Path, seed: int, updates: int
) -> dict[str, Any]:
    """Train a network on a simulator, and run it on the rig; errors as of :func:`tuned_on`."""
    trained = residual_mlp.train(
        [LUNG],
        out,
        config=residual_mlp.ResidualConfig(updates=updates, members=1),
        seeds=[seed],
        gains=np.array([best]),  # the grid was searched before
        simulator=simulator,
    )
    nominal, drawn = errors(trained.controllers[LUNG], plant)
    promised = trained.report["networks"][LUNG]["error"][LUNG]
    return {"promised": promised, "rig": nominal, "draws": drawn.tolist()}


def run(
    name: str, out: Path, breaths: int, iterations: int, seeds: Sequence[int], updates: int
) -> dict[str, Any]:
    """Close the loop on one rig; finished parts are read from ``out``."""
    concealed, plant = RIGS[name], rig_of(RIGS[name])
    settings = {"rig": name, "words": concealed.words, "breaths": breaths}
    settings |= {"iterations": iterations, "updates": updates}
    work, folder = WorkFolder(out / "parts", settings), out / "recordings"

    def diagnosed() -> list[str]:
        folder.mkdir(parents=True, exist_ok=True)
        diagnosis = diagnose(record(plant, folder / "rig.csv", breaths), simulator="physics")
        diagnosis.save(out / "diagnosis")
        return [mechanism.name for mechanism in diagnosis.mechanisms]

    missing = work.get("missing", diagnosed)
    print(f"{name}: missing {', '.join(missing) or 'nothing'}", flush=True)
    simulators: dict[str, Any] = {SIMULATORS[0]: {LUNG: physics(lung(LUNG))}}
    corrected, learned = out / "diagnosis" / "corrected.json", out / "learned"
    if corrected.is_file():
        simulators[SIMULATORS[1]] = corrected
    if iterations:
        if not (learned / "manifest.toml").is_file():
            config = RigConfig(resamples=2, fit=FitConfig(iterations=iterations))
            train_rigs(folder, learned, config=config)
        simulators[SIMULATORS[2]] = learned
    simulators[SIMULATORS[3]] = {LUNG: plant}
    rows = {}
    for label, simulator in simulators.items():
        number = SIMULATORS.index(label)
        pid = work.get(f"pid-{number}", partial(tuned_on, simulator, plant))
        networks = []
        for seed in seeds:
            place = out / f"trained-{number}" / f"residual-{seed}"
            train = partial(trained_on, simulator, pid["gains"], plant, place, seed, updates)
            networks.append(work.get(f"residual-{number}-{seed}", train))
        rows[label] = {"pid": pid, "residual": networks}
        for part in (pid, *networks):
            print(f"{label:24} {part['promised']:6.3f} -> {part['rig']:6.3f} cmH2O", flush=True)
    return {"missing": missing, "trained_on": rows}


def table(name: str, result: Mapping[str, Any]) -> str:
    """Figures of one rig as Markdown."""
    rows, words = result["trained_on"], RIGS[name].words
    missing = ", ".join(f"`{mechanism}`" for mechanism in result["missing"]) or "nothing"
    kinds = [("pid", "PID")]
    if all(row["residual"] for row in rows.values()):
        kinds.append(("residual", "network"))

    head = ["trained on"]
    for _, title in kinds:
        head += [f"{title}: promised", "on the rig", "20 draws"]
    lines = [
        f"**{words[0].upper()}{words[1:]}.** The diagnosis names {missing}.",
        "",
        f"| {' | '.join(head)} |",
        f"|{' --- |' * len(head)}",
    ]
    for label, row in rows.items():
        cells = [label]
        for kind, _ in kinds:
            parts = row[kind] if kind == "residual" else [row[kind]]
            figures = [
                np.mean([part[name] for part in parts]) for name in ("promised", "rig", "draws")
            ]
            cells += [f"{value:.3f}" for value in figures]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(
    out: Path = Path("runs/own_rig"),
    rig: Literal["late", "leak", "droop", "all"] = "all",
    breaths: int = 36,
    iterations: int = 240,
    seeds: int = 3,
    updates: int = 600,
) -> None:
    """A rig of one's own, end to end: recordings, what a simulator lacks, a better controller.

    --iterations: of learning; 0 leaves it out.
    --seeds: of networks; 0: only a PID.
    """
    names = list(RIGS) if rig == "all" else [rig]
    for name in names:
        result = run(name, out / name, breaths, iterations, range(seeds), updates)
        print(table(name, result), end="\n\n")


if __name__ == "__main__":
    typer.run(main)
