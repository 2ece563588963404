"""Every table and figure of the paper that needs no hardware, made again and set beside ours.

What takes seconds is computed: the PID grid, the bundled entries, an exploration. What takes
minutes or needs recordings is read from ``data/paper.json``, where an earlier run of
:func:`reproduce_paper` with ``full`` and ``recordings`` has stored it with its provenance.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import ventbench
from ventbench import data_files, environment, files, precision, protocol, rollouts, waveform
from ventbench.controllers.pid import PID
from ventbench.errors import InputError
from ventbench.executor import executor, results
from ventbench.lungs import LUNG_IDS, lung
from ventbench.metrics import open_loop, step_response
from ventbench.plants import frozen
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants, take
from ventbench.plants.two_balloon import two_balloon
from ventbench.recordings import load
from ventbench.reproduction import published
from ventbench.reproduction.report import (
    Cell,
    Chart,
    HeatMap,
    Line,
    Reproduction,
    Section,
    Table,
    Verdict,
)
from ventbench.submissions.scoring import score
from ventbench.training import pid_grid
from ventbench.training.exploration import RANGES, SimulatedVentilator, explore
from ventbench.training.simulator import MEASURED

Floats = NDArray[np.float64]
AnyFloats = NDArray[np.floating]

#: File of stored results in the folder ``data``.
STORED = "paper.json"

#: Entry and track by the name that tables have.
ENTRIES = {
    "residual": ("residual_mlp", "performance"),
    "residual, all lungs": ("residual_mlp_all", "robustness"),
    "PPO": ("ppo", "performance"),
    "DQN": ("dqn", "performance"),
}

#: Kinds of simulators whose error is shown by horizon, as tables name them.
KINDS = {
    "hybrid": "hybrid (official)",
    "network": "network (the paper's kind)",
    "single_compartment": "R-C lung",
    "two_balloon": "two balloons",
}

#: The lung of the paper's figure of open-loop distance and of its figure of exploration.
SHOWN = "R5C50"

#: Lung and PIP of the example of trajectories; the paper does not name its own.
EXAMPLE, EXAMPLE_PIP = "R20C20", 20.0

#: Steps after the start at which errors by horizon are tabulated.
HORIZONS = (1, 3, 5, 10, 15, 20, 25, 28)

#: Error at the end of the horizon over its mean, up to which it is said not to grow.
GROWTH = 1.5

#: Breaths of the exploration.
BREATHS = 64

#: Points of a stored learning curve.
CURVE_POINTS = 40

#: Called with what is done and the share of all that is done.
Progress = Callable[[str, float], None]


def reproduce_paper(
    *,
    protocol_version: int = 2,
    recordings: Path | str | None = None,
    full: bool = False,
    out: Path | str = "runs/paper",
    seeds: int = 5,
    workers: int = 0,
    scheduler: str | None = None,
    gains: NDArray[np.float64] | None = None,
    stored: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> tuple[Reproduction, dict[str, Any]]:
    """Set the paper's tables, figures and claims beside ours.

    Args:
        protocol_version: 2 scores airway pressure on the reference rigs; 1 the first simulators.
        recordings: folder of the public recordings: errors by horizon are measured again.
        full: run the studies again too: learning curves, parts of the controller and, with
            ``recordings``, architectures; an hour on 2 cores.
        out: folder in which ``full`` keeps finished trainings, so that the same call continues.
        seeds: trainings of each method in the learning curves.
        workers: processes for grid and entries; 0 for this one alone.
        scheduler: address of a Dask scheduler instead.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``; the paper's 8,000 if not given. They must
            contain those of the paper's table.
        stored: results of minutes; those of ``data/paper.json`` if not given.
        progress: see :data:`Progress`.

    Returns:
        The comparison, and what ``data/paper.json`` should hold after this run.

    Raises:
        InputError: if the version is unknown, a recording is malformed, or ``out`` is of other
            studies.

    Examples:
        >>> import ventbench
        >>> page, _ = ventbench.reproduce_paper()  # doctest: +SKIP
        >>> print(page)  # doctest: +SKIP
    """
    if protocol_version not in (1, 2):
        raise InputError(f"protocol {protocol_version} is not known; the versions are 1 and 2")
    tell = progress or (lambda what, share: None)
    official = frozen.load(version=protocol_version)
    kept = dict(load_stored() if stored is None else stored)
    if recordings is not None:
        tell("errors by horizon", 0.0)
        kept["horizon"] = measure_horizon(Path(recordings) / MEASURED)
    if full:
        kept |= _studies(Path(out), None if recordings is None else Path(recordings), seeds, tell)
    with executor(workers, scheduler) as pool:
        tell("PID grid", 0.1)
        grid = pid_grid.search(
            {name: take(official.plants, index) for index, name in enumerate(LUNG_IDS)},
            settings=official.about(),
            gains=gains,
            pool=pool,
            errors_of=partial(_grid_errors, airway=protocol_version == 2),
        )
        jobs = {name: (*entry, protocol_version) for name, entry in ENTRIES.items()}
        scored: dict[str, tuple[Floats, Floats]] = {}
        for name, result in results(pool, _scored, jobs):
            scored[name] = result
            tell(f"{name} scored", 0.4 + 0.4 * len(scored) / len(jobs))
    errors = {name: result[0] for name, result in scored.items()}
    tell("exploration and examples", 0.9)
    sections = (
        simulators(official, kept["horizon"]),
        by_horizon(kept["horizon"]),
        architectures(kept["networks"]),
        exploration(official),
        best_gains(grid),
        example(official, grid, scored["residual"][1], airway=protocol_version == 2),
        performance(grid, errors["residual"]),
        robustness(grid, errors["residual"], errors["residual, all lungs"]),
        regularisation(kept["controllers"]),
        reinforcement(errors),
        sample_efficiency(kept["samples"]),
    )
    about = {
        "ventbench": ventbench.__version__,
        "protocol": protocol_version,
        "simulators": official.manifest_sha256[:12],
    }
    return Reproduction(about, sections, published.NOT_REPRODUCED), kept


def load_stored(path: Path | None = None) -> dict[str, Any]:
    """Read stored results.

    Raises:
        InputError: if they are missing or not JSON.
    """
    path = path or data_files.data_path(STORED)
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error


def measure_horizon(recording: Path) -> dict[str, Any]:
    """Open-loop errors of every kind of simulator on measured breaths, by horizon, as JSON values.

    Hybrids (version 2) and networks (version 1) are judged by the member of their ensemble that has
    not seen the breath; the physics knows no more than the label.

    Args:
        recording: file of measured breaths in the public schema.

    Raises:
        InputError: if it is missing or malformed.
    """
    breaths = load(recording)
    breaths = breaths.select(np.flatnonzero(np.isin(breaths.lung_ids, LUNG_IDS)))
    official, networks = frozen.load(version=2), frozen.load_learned()
    judged = {
        "hybrid": official.cross_fitted,
        "network": networks.cross_fitted,
        "single_compartment": partial(nominal_plants, single_compartment),
        "two_balloon": partial(nominal_plants, two_balloon),
    }
    lungs: dict[str, Any] = {
        name: {"breaths": len(index)} for name, index in breaths.by_lung_index.items()
    }
    for kind, plants_for in judged.items():
        simulated = np.nan_to_num(rollouts.open_loop_breaths(plants_for, breaths))
        for name, index in breaths.by_lung_index.items():
            pair = (breaths.pressure[index], simulated[index], breaths.inspiratory[index])
            curve = open_loop.by_horizon(*pair)
            lungs[name][kind] = {
                "mae": round(float(np.nanmean(open_loop.mae(*pair))), 4),
                "median_mae": round(float(np.nanmedian(open_loop.mae(*pair))), 4),
                "distance": round(float(np.nanmean(open_loop.distance(*pair))), 3),
                "by_step": [round(x, 4) for x in curve[np.isfinite(curve)].tolist()],
            }
    return {
        "about": {
            "recording": files.sha256(recording),
            "simulators": official.manifest_sha256,
            "command": "ventbench reproduce paper --recordings DIR",
        },
        "step_s": round(float(np.median(breaths.dt[breaths.valid])), 4),
        "lungs": {name: lungs[name] for name in LUNG_IDS if name in lungs},
    }


def simulators(official: frozen.Frozen, horizon: Mapping[str, Any]) -> Section:
    """Open-loop errors of the simulators beside the paper's (its table 3)."""
    rows: list[tuple[Cell, ...]] = []
    below = 0
    for name, about in official.lungs().items():
        own = "own_rig" if "own_rig_mae" in about else "held_out"
        here = [about.get(f"{kind}_{x}") for kind in (own, "unseen_rig") for x in _MEANS]
        others = [horizon["lungs"][name][kind]["mae"] for kind in KINDS if kind != "hybrid"]
        rows.append((name, published.OPEN_LOOP[name], *here, *others))
        below += about[f"{own}_median_mae"] <= published.OPEN_LOOP[name]
    numbers = np.array([row[1:] for row in rows], float)
    paper, hybrid, network, rc, balloons = numbers.mean(axis=0)[[0, 1, 5, 6, 7]].tolist()
    physics = min(rc, balloons)
    finding = (
        f"By median {below} of 6 lungs are at or below the paper's error; the mean over lungs is "
        f"{hybrid:.2f} (paper {paper:.2f}) cmH2O for the hybrid and {network:.2f} for a network of "
        f"the paper's kind. Physics from labels alone has {physics:.2f}: {physics / network:.1f} "
        f"times the network's, {physics / hybrid:.1f} times the hybrid's, not an order of "
        "magnitude; and the hybrid, physics with learned curves, beats the pure network."
    )
    columns = (
        "lung", "paper, mean", "hybrid, own rig, mean", "median", "unseen rig, mean", "median",
        "network", "R-C lung", "two balloons",
    )  # fmt: skip
    return Section(
        "simulators", "Errors of the simulators", "table 3, conclusion 1",
        "Networks model ventilator and lung far better than physics-based models.",
        "in part" if network < physics else "differs", finding,
        "held-out errors of the official simulators; the others from recordings, stored",
        (
            Table(
                "Open-loop mean absolute error on held-out breaths, cmH2O", columns, tuple(rows), 2
            ),
        ),
    )  # fmt: skip


_MEANS = ("mae", "median_mae")


def by_horizon(horizon: Mapping[str, Any]) -> Section:
    """Error after so many steps without feedback (the paper's figure 5 and table 5)."""
    lungs = horizon["lungs"]
    rows: list[tuple[Cell, ...]] = []
    for name, about in lungs.items():
        curve = about["hybrid"]["by_step"]
        at = [curve[k - 1] if k <= len(curve) else None for k in HORIZONS]
        rows.append((name, about["hybrid"]["distance"], *at))
    growth = {
        name: about["hybrid"]["by_step"][HORIZONS[-1] - 1] / np.mean(about["hybrid"]["by_step"])
        for name, about in lungs.items()
    }
    flat = [name for name, value in growth.items() if value <= GROWTH]
    shown = lungs[SHOWN]

    def line(kind: str, title: str) -> Line:
        curve = shown[kind]["by_step"]
        return Line(title, tuple(float(k + 1) for k in range(len(curve))), tuple(curve))

    verdict: Verdict = "agrees" if len(flat) == len(lungs) else "in part" if flat else "differs"
    return Section(
        "horizon", "Error by horizon", "figure 5, table 5",
        "The error stays low as more steps are projected.",
        verdict,
        f"At step {HORIZONS[-1]} the error is at most {GROWTH:g} times its mean over the horizon "
        f"on {len(flat)} of {len(lungs)} lungs (largest ratio {max(growth.values()):.2f}).",
        "held-out measured breaths, stored; `--recordings DIR` measures again",
        (
            Table(
                "Hybrid: open-loop distance (sum over steps) and error after n steps, cmH2O",
                ("lung", "distance", *(f"step {k}" for k in HORIZONS)), tuple(rows), 2,
            ),
        ),
        (
            Chart(
                f"{SHOWN}: open-loop error by horizon", "steps after the start", "cmH2O",
                tuple(line(kind, title) for kind, title in KINDS.items()),
            ),
        ),
    )  # fmt: skip


def architectures(networks: Mapping[str, Any]) -> Section:
    """The paper's search over network shapes (its table 4)."""
    base, rows = networks["base"], []
    variants = {row["variant"]: row for row in networks["variants"]}
    clear = [
        name for name, row in variants.items()
        if row.get("low95") is not None and (row["low95"] > 0 or row["high95"] < 0)
    ]  # fmt: skip
    for setting, values in published.ARCHITECTURES.items():
        ours = {int(base[setting]): variants["base"]}
        ours |= {
            int(name.split()[1]): row
            for name, row in variants.items()
            if name.split()[0] == setting
        }
        for value in sorted({*values, *ours}):
            row = ours.get(value)
            figures = (row["R5C10"], row["mean"]) if row else (None, None)
            rows.append((f"{setting} {value}", values.get(value), *figures))
    return Section(
        "architectures", "Shapes of the networks", "table 4",
        "More expressive networks gain a little, and the gains plateau quickly.",
        "agrees" if len(clear) < len(variants) // 3 else "in part",
        f"{len(clear)} of {len(variants) - 1} changes have a paired 95 % interval without zero: "
        f"{', '.join(clear) or 'none'}.",
        f"`{networks['about']['command']}`, stored; one setting changed at a time from "
        + ", ".join(f"{name} {value}" for name, value in base.items()),
        (
            Table(
                "Open-loop error on held-out breaths, cmH2O",
                ("setting", "paper, R5C10", "here, R5C10", "here, mean of six lungs"),
                tuple(rows), 2,
            ),
        ),
    )  # fmt: skip


def exploration(official: frozen.Frozen) -> Section:
    """Exploratory breaths on a simulator (the paper's figure 6 and table 1)."""
    index = LUNG_IDS.index(SHOWN)
    with precision.float32():
        plant = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, jnp.float32), take(official.plants, index)
        )
        breaths = explore(SimulatedVentilator(plant, BREATHS, noise=0.2), SHOWN, BREATHS, seed=0)
    inspired = np.where(breaths.inspiratory, 1.0, np.nan)
    u_in, pressure = breaths.u_in * inspired, breaths.pressure * inspired

    common = int(np.min(np.count_nonzero(breaths.inspiratory, axis=1)))

    def spread(values: Floats) -> tuple[float, float]:
        low, high = np.quantile(values[:, 2:common], (0.05, 0.95), axis=0)
        return float(np.mean(high - low)), float(np.nanmax(values))

    (wide, most), (narrow, peak) = spread(u_in), spread(pressure)
    ranges = RANGES[SHOWN]
    rows = (
        ("P, I, D", ", ".join(f"{gain:g}" for gain in ranges.gains)),
        ("boundary, added %", f"{ranges.boundary_u[0]:g} to {ranges.boundary_u[1]:g}"),
        ("triangle, added %", f"{ranges.triangular_u[0]:g} to {ranges.triangular_u[1]:g}"),
        ("share of boundary breaths", f"{ranges.boundary_share:g}"),
        ("command, spread between breaths (5 to 95 %), %", f"{wide:.1f}"),
        ("pressure, spread between breaths (5 to 95 %), cmH2O", f"{narrow:.1f}"),
        ("highest command, %; highest pressure, cmH2O", f"{most:.0f}; {peak:.1f}"),
    )
    safe = peak <= 60.0
    return Section(
        "exploration", "Exploratory breaths", "figure 6, table 1",
        "Exploration covers a wide range of controls and stays in a limited, safe range of "
        "pressures.",
        "agrees" if safe and wide / 100.0 > narrow / 60.0 else "in part",
        f"Commands spread over {wide:.0f} of 100 % and pressures over {narrow:.1f} of 60 cmH2O "
        f"between breaths; the highest pressure is {peak:.1f} cmH2O.",
        f"computed: {BREATHS} breaths of {SHOWN}, with the paper's ranges of that lung",
        (Table(f"Exploration of {SHOWN}", ("quantity", "value"), rows),),
    )  # fmt: skip


def best_gains(grid: pid_grid.PIDGrid) -> Section:
    """The grid of PIDs (the paper's table 2) and its map over P and I."""
    rows: list[tuple[Cell, ...]] = []
    without = grid.gains[:, 2] == 0.0
    excess = []
    for index, name in enumerate(grid.lungs):
        error = grid.error[index].mean(axis=-1, dtype=np.float64)
        paper = _index(grid.gains, published.BEST_PID[name])
        best, pi = int(np.argmin(error)), int(np.argmin(np.where(without, error, np.inf)))
        better = float(np.mean(error[without] < error[paper]))
        excess.append(error[paper] / error[pi] - 1.0)
        rows.append(
            (
                name, _gains(grid.gains[paper], 2), float(error[paper]), _gains(grid.gains[pi], 2),
                float(error[pi]), _gains(grid.gains[best]), float(error[best]),
                f"{100 * better:.1f} %",
            )
        )  # fmt: skip
    maps = tuple(_gain_map(grid, name) for name in grid.lungs)
    top = sum(value < 0.05 for value in excess)
    return Section(
        "pid", "Best PIDs", "table 2",
        "The best gains are high, several at the end of the grid, and all have D = 0.",
        "agrees" if top >= 5 else "in part",
        f"On {top} of {len(excess)} lungs the gains that were best on the physical lung come "
        "within 5 % of the best P and I on the simulator, which was not fitted to them. With D "
        "free, the error on simulators is lower.",
        f"computed: {grid.error.size:,} trajectories without noise (the paper: "
        f"{published.TRAJECTORIES * len(grid.lungs):,} on the lung)",
        (
            Table(
                "Mean |pressure - PIP|, cmH2O, of the paper's best P, I; of the best with D = 0; "
                "of the best of the whole grid; share of P, I that beat the paper's",
                ("lung", "paper P, I", "error here", "best P, I", "error", "best P, I, D", "error",
                 "better than the paper's"),
                tuple(rows),
            ),
        ),
        maps=maps,
    )  # fmt: skip


def example(
    official: frozen.Frozen, grid: pid_grid.PIDGrid, residual: Floats, *, airway: bool
) -> Section:
    """Trajectories of P-only, I-only, PID and residual (the paper's figures 2, 4 and 9).

    Args:
        official: simulators.
        grid: grid of PIDs.
        residual: pressures of the residual entry, cmH2O, shape ``(6, 6, 300)``.
        airway: take airway pressure, not the reading.
    """
    at, pip = LUNG_IDS.index(EXAMPLE), protocol.PIPS.index(EXAMPLE_PIP)
    P, I, D = grid.gains.T  # noqa: E741
    kinds = {
        "best P-only": (I == 0) & (D == 0),
        "best I-only": (P == 0) & (D == 0),
        "best PI of the paper": np.all(grid.gains == published.BEST_PID[EXAMPLE], axis=1),
        "best PID of the grid": np.ones(len(P), bool),
    }
    error = grid.error[at].mean(axis=-1, dtype=np.float64)
    chosen = {
        name: tuple(grid.gains[int(np.argmin(np.where(among, error, np.inf)))].tolist())
        for name, among in kinds.items()
        if np.any(among)
    }
    with precision.float64():
        plant = jax.tree.map(lambda leaf: jnp.asarray(leaf[at], float), official.plants)
        controllers = PID(*(jnp.asarray(column) for column in zip(*chosen.values(), strict=True)))
        cells = environment.nominal_scenario(np.full(len(chosen), EXAMPLE_PIP))
        inspired, expired = rollouts.closed_loop(
            plant, controllers, cells, whole=True, airway=airway
        )
        assert expired is not None
        breaths = np.concatenate([inspired.pressure, expired.pressure], axis=-1)
    runs = {name: breaths[k].reshape(-1) for k, name in enumerate(chosen)}
    runs["residual"] = residual[at, pip]
    rows = []
    last = protocol.BREATH_STEPS * (protocol.BREATHS - 1)
    for name, run in runs.items():
        breath = run[last : last + protocol.INSPIRATION_STEPS]
        rows.append(
            (
                name,
                _gains(chosen[name]) if name in chosen else "network on PID",
                float(np.mean(np.abs(breath - EXAMPLE_PIP))),
                float(step_response.rise_time(breath, protocol.PEEP, EXAMPLE_PIP, protocol.DT)),
                float(step_response.overshoot(breath, EXAMPLE_PIP)),
                float(step_response.swings(breath, EXAMPLE_PIP)),
            )
        )
    ours, others = rows[-1], rows[:-1]
    faster = all(not ours[3] > row[3] for row in others if np.isfinite(row[3]))
    nearer = all(ours[2] < row[2] for row in others)
    verdict: Verdict = "agrees" if faster and nearer else "in part" if nearer else "differs"
    steps = np.arange(protocol.BREATH_STEPS)
    time = tuple((steps * protocol.DT).tolist())
    target = tuple(np.asarray(waveform.target(steps, EXAMPLE_PIP), float).tolist())
    lines = tuple(Line(name, time, tuple(run[last:].tolist())) for name, run in runs.items())
    return Section(
        "example", "Trajectories of one breath", "figures 2, 4 and 9",
        "The trained controller rises fast and stays near the target; P-only, I-only and PID rise "
        "later, overshoot or ring.",
        verdict,
        f"Error {ours[2]:.2f} cmH2O, rise {ours[3]:.2f} s, overshoot {ours[4]:.2f} cmH2O, against "
        f"at best {min(row[2] for row in others):.2f} cmH2O by a PID. The example's lung and PIP "
        "are ours; the paper names none.",
        f"computed: {EXAMPLE} at PIP {EXAMPLE_PIP:g}, third breath",
        (
            Table(
                "Third breath: error, cmH2O; rise from 10 to 90 %, s; overshoot, cmH2O; swings "
                "around the target",
                ("controller", "P, I, D", "error", "rise", "overshoot", "swings"), tuple(rows), 2,
            ),
        ),
        (
            Chart(
                f"{EXAMPLE} at PIP {EXAMPLE_PIP:g} cmH2O", "time in the breath, s",
                "pressure, cmH2O", (Line("target", time, target, dashed=True), *lines),
            ),
        ),
    )  # fmt: skip


def performance(grid: pid_grid.PIDGrid, residual: Floats) -> Section:
    """Residual network against the best PID of each lung (the paper's figure 7).

    Args:
        grid: grid of PIDs.
        residual: errors by lung and PIP, cmH2O, shape ``(6, 6)``.
    """
    pid = np.stack(
        [grid.error[k, int(np.argmin(grid.error[k].mean(-1)))] for k in range(len(grid.lungs))]
    )
    by_lung = tuple(_compared(name, pid[k], residual[k]) for k, name in enumerate(grid.lungs))
    by_pip = tuple(
        _compared(f"PIP {pip:g}", pid[:, k], residual[:, k]) for k, pip in enumerate(grid.pips)
    )
    wins = sum(row[2] < row[1] for row in by_lung)
    verdict: Verdict = "agrees" if wins == 6 else "in part" if wins >= 3 else "differs"
    heads = ("best PID of the lung", "residual", "change, %")
    return Section(
        "performance", "A trained controller for each lung", "figure 7, contribution 1",
        "A network on top of a PID, trained on the simulator, beats the best PID on every lung.",
        verdict,
        f"It is better on {wins} of 6 lungs and at {sum(row[2] < row[1] for row in by_pip)} of 6 "
        f"PIPs; the mean falls from {pid.mean():.3f} to {residual.mean():.3f} cmH2O "
        f"({_change(pid, residual):+.0f} %).",
        "computed: submissions/residual_mlp and the grid, nominal runs, on simulators",
        (
            Table("Mean |pressure - PIP| by lung, cmH2O", ("lung", *heads), by_lung, 2),
            Table("The same by waveform, cmH2O", ("waveform", *heads), by_pip, 2),
        ),
    )  # fmt: skip


def robustness(grid: pid_grid.PIDGrid, own: Floats, residual: Floats) -> Section:
    """One controller for all lungs against one PID for all (the paper's figure 8).

    Args:
        grid: grid of PIDs.
        own: errors of the networks for single lungs, cmH2O, shape ``(6, 6)``.
        residual: errors of the network for all lungs, cmH2O, shape ``(6, 6)``.
    """
    gains, _ = grid.best()
    pid = grid.error[:, _index(grid.gains, gains)]
    each = np.stack([error[int(np.argmin(error.mean(-1)))] for error in grid.error])
    rows = tuple(_compared(name, pid[k], residual[k]) for k, name in enumerate(grid.lungs))
    gain, single = _change(pid, residual), _change(each, own)
    wins = sum(row[2] < row[1] for row in rows)
    verdict: Verdict = "agrees" if wins == 6 and gain < single else "in part"
    return Section(
        "robustness", "One controller for all lungs", "figure 8, contribution 2",
        "One network for all lungs beats the best single PID, by more than networks for single "
        "lungs beat their PIDs.",
        verdict,
        f"{gain:+.0f} % against the single PID ({_gains(gains)}) over six lungs, {single:+.0f} % "
        f"for networks of single lungs against theirs; better on {wins} of 6 lungs. On average it "
        f"also has {residual.mean():.3f} cmH2O where the best PIDs of each lung have "
        f"{each.mean():.3f}.",
        "computed: submissions/residual_mlp_all and the grid, nominal runs",
        (
            Table(
                "Mean |pressure - PIP|, cmH2O; neither is told the lung",
                ("lung", "best single PID", "one network", "change, %"), rows, 2,
            ),
        ),
    )  # fmt: skip


def regularisation(controllers: Mapping[str, Any]) -> Section:
    """Network on a PID against a network alone (the paper's section 5)."""
    variants = {row["variant"]: row for row in controllers["variants"]}
    base, direct = variants["base"], variants["direct"]
    rows = tuple(
        (name, row["meaning"], row["nominal"], row["draws"], row["exploitation"])
        for name, row in variants.items()
    )
    better = direct["nominal"] > base["nominal"]
    return Section(
        "regularisation", "The PID under the network", "section 5",
        "A correction of a PID does significantly better than a network that commands alone.",
        "agrees" if better else "differs",
        f"A network alone has {direct['nominal']:.3f} cmH2O, one on a PID {base['nominal']:.3f}; "
        f"but its exploitation index, the spread of the ensemble under its commands, is "
        f"{direct['exploitation']:.3f} against {base['exploitation']:.3f}. On simulators the PID "
        "keeps the network where they agree; it does not lower the error.",
        f"`{controllers['about']['command']}`, stored, simulators version "
        f"{controllers['about']['simulators']}",
        (
            Table(
                "Parts of the residual controller: error without noise and on the draws, and "
                "exploitation index, cmH2O",
                ("variant", "what", "nominal", "draws", "exploitation"), rows,
            ),
        ),
    )  # fmt: skip


def reinforcement(errors: Mapping[str, Floats]) -> Section:
    """Residual network, PPO and DQN on the lungs (the paper's figure 10)."""
    names = ("residual", "PPO", "DQN")
    rows = [
        (lung_id, *(float(errors[name][k].mean()) for name in names))
        for k, lung_id in enumerate(LUNG_IDS)
    ]
    rows.append(("mean", *(float(errors[name].mean()) for name in names)))
    ours, ppo, dqn = (float(x) for x in rows[-1][1:])
    return Section(
        "reinforcement", "Against PPO and DQN", "figure 10",
        "The score is comparable to that of PPO and DQN on all simulators.",
        "agrees" if ours <= 1.05 * min(ppo, dqn) else "differs",
        f"{ours:.3f} cmH2O against {ppo:.3f} (PPO) and {dqn:.3f} (DQN), after a handful of trials "
        f"each (the paper: {published.TRIALS['PPO']} and {published.TRIALS['DQN']}).",
        "computed: submissions residual_mlp, ppo, dqn, performance track, nominal runs",
        (Table("Mean |pressure - PIP|, cmH2O", ("lung", *names), tuple(rows)),),
    )  # fmt: skip


def sample_efficiency(samples: Mapping[str, Any]) -> Section:
    """Error against experience (the paper's figure 11)."""
    methods = {row["method"]: row for row in samples["methods"]}
    columns = (
        "final", "low95", "high95", "episodes", "at_100_episodes", "episodes_to_best_pid",
        "episodes_to_2_percent",
    )  # fmt: skip
    rows = tuple(
        (name, *(_plain_number(row[key]) for key in columns)) for name, row in methods.items()
    )
    gradient = methods["policy-gradient"]
    others = [methods[name]["episodes_to_best_pid"] for name in ("ppo", "dqn")]
    short = methods["policy-gradient-short"]
    fewer = [x / gradient["episodes_to_best_pid"] for x in others]
    close = short["final"] <= 1.02 * min(row["final"] for row in methods.values())
    lines = tuple(
        Line(name, tuple(curve["episodes"]), tuple(curve["score"]))
        for name, curve in samples["curves"].items()
    )
    chart = Chart(
        f"{samples['lung']}: score without noise against experience", "breaths", "cmH2O", lines,
        logarithmic=True,
    )  # fmt: skip
    return Section(
        "samples", "Breaths of experience", "figure 11, contribution 4, conclusion 3",
        "The policy gradient converges in about 100 episodes, PPO and DQN in tens of thousands.",
        "agrees" if close else "in part",
        f"It beats the best PID after {gradient['episodes_to_best_pid']} breaths, {fewer[0]:.0f} "
        f"and {fewer[1]:.0f} times fewer than PPO and DQN. But within 96 breaths it stops at "
        f"{short['final']:.2f} cmH2O, and with {gradient['episodes']:,} it reaches "
        f"{gradient['final']:.2f}. An episode here is one inspiration; in the paper a pass over "
        "all PIPs.",
        f"`{samples['about']['command']}`, stored, simulators version "
        f"{samples['about']['simulators']}; {samples['seeds']} seeds",
        (
            Table(
                f"{samples['lung']}: score without noise, cmH2O (interquartile mean, 95 %), and "
                "breaths",
                ("method", "final", "from", "to", "breaths", "score at 100 breaths",
                 "breaths to the best PID", "breaths to within 2 %"),
                rows,
            ),
        ),
        (chart,) if lines else (),
    )  # fmt: skip


def _grid_errors(plant: Any, gains: Floats, *, airway: bool) -> NDArray[np.float32]:
    stacked = jax.tree.map(lambda leaf: np.asarray(leaf)[None], plant)
    return pid_grid.errors(stacked, gains, airway=airway)[0]


def _scored(name: str, track: str, version: int) -> tuple[Floats, Floats]:
    """Errors and pressures of a bundled entry without noise, by lung and PIP."""
    result = score(name, track=track, sandbox=False, protocol=version)
    return result.nominal, result.trajectories.pressure


def _studies(
    out: Path, recordings: Path | None, seeds: int, tell: Progress
) -> dict[str, dict[str, Any]]:
    """Run the studies of minutes again, as JSON values."""
    from ventbench.training import study
    from ventbench.training.ablation import controllers, networks
    from ventbench.training.residual import ResidualConfig
    from ventbench.training.simulator import ARCHITECTURE

    kept: dict[str, dict[str, Any]] = {}
    curves = study.sample_efficiency(
        lung("R20C50"), range(seeds), out / "samples",
        progress=lambda method, share, best: tell(f"learning curves: {method}", share),
    )  # fmt: skip
    kept["samples"] = stored_samples(curves, seeds)
    config = ResidualConfig(updates=1000)
    runs = controllers.compare(
        frozen.load(), out / "controllers", [0], config=config,
        progress=lambda what, share: tell(f"controllers: {what}", share),
    )  # fmt: skip
    known = controllers.variants(config)
    kept["controllers"] = {
        "about": {"command": "ventbench study controllers --seeds 1", "simulators": 1},
        "variants": [
            {"variant": row["variant"], "meaning": known[str(row["variant"])].meaning}
            | {figure: round(float(row[figure]), 4) for figure in controllers.FIGURES}
            for row in controllers.summary(runs).to_dict("records")
        ],
    }
    if recordings is not None:
        breaths = networks.compare(
            recordings, out / "networks",
            progress=lambda what, share: tell(f"networks: {what}", share),
        )  # fmt: skip
        names = {"depth": "depth", "N_B": "boundaries", "H_p": "pressures", "H_c": "controls"}
        base = {key: getattr(ARCHITECTURE, field) for key, field in names.items()}
        table = networks.summary(breaths).round(4)
        kept["networks"] = {
            "about": {"command": "ventbench study networks", "simulators": 1},
            "base": base | {"width": ARCHITECTURE.width},
            "variants": table.to_dict("records"),
        }
    return kept


def stored_samples(curves: Any, seeds: int) -> dict[str, Any]:
    """Learning curves as ``data/paper.json`` has them: a few points, evenly apart in logarithms."""
    lines = {}
    for curve in curves.curves:
        last = len(curve.episodes) - 1
        at = np.unique(np.geomspace(1, max(last, 1), CURVE_POINTS).round().astype(int))
        lines[curve.method] = {
            "episodes": curve.episodes[at].tolist(),
            "score": np.round(curve.middle[at], 4).tolist(),
        }
    rows = curves.summary().to_dict("records")
    return {
        "about": {"command": f"ventbench study samples --seeds {seeds}", "simulators": 1},
        "lung": curves.lung,
        "seeds": seeds,
        "methods": [{k: None if v != v else v for k, v in row.items()} for row in rows],
        "curves": lines,
    }


def _compared(name: str, before: AnyFloats, after: AnyFloats) -> tuple[str, float, float, float]:
    return name, float(np.mean(before)), float(np.mean(after)), _change(before, after)


def _change(before: AnyFloats, after: AnyFloats) -> float:
    """Change of the mean, %."""
    return 100.0 * (float(np.mean(after)) / float(np.mean(before)) - 1.0)


def _index(gains: Floats, wanted: Sequence[float]) -> int:
    at = np.flatnonzero(np.all(gains == np.asarray(wanted), axis=1))
    if not at.size:
        raise InputError(f"the grid does not contain P, I, D = {_gains(wanted)}")
    return int(at[0])


def _gains(gains: Sequence[float] | Floats, count: int = 3) -> str:
    return ", ".join(f"{gain:g}" for gain in list(gains)[:count])


def _plain_number(value: float | None) -> Cell:
    return f"{value:,}" if isinstance(value, int) else value


def _gain_map(grid: pid_grid.PIDGrid, name: str) -> HeatMap:
    """Error over P and I with D = 0."""
    here = grid.gains[:, 2] == 0.0
    (P, row), (I, column) = (  # noqa: E741
        np.unique(grid.gains[here, k], return_inverse=True) for k in (0, 1)
    )
    values = np.full((P.size, I.size), np.nan)
    error = grid.error[grid.lungs.index(name)].mean(axis=-1, dtype=np.float64)
    values[row, column] = np.round(error[here], 4)
    plain = tuple(tuple(line) for line in values.tolist())
    return HeatMap(f"{name}, D = 0, cmH2O", "I", "P", tuple(I.tolist()), tuple(P.tolist()), plain)
