"""Searches for PID gains: on the paper's grid, and without a grid's edge.

**Grid.** Every PID of the grid runs on every lung and PIP without noise. Each breath of a run is
then the same, as each begins at rest and the PID starts anew, so one inspiration stands for all.
The best of the grid then run on draws for tuning, whose noise a high gain amplifies, and the least
mean error wins: the gains of the entries ``pid_best`` and ``pid_robust``.

**Without an edge**: the 100 of normalised scores. Gains are searched for in their logarithms by
Nelder and Mead's simplex on the mean error over draws: their noise and gains are fixed, so that the
error is a function of the gains alone. The search begins at the best points of a coarse grid that
reaches far beyond the paper's, each a simplex of its own. The optimum is taken for one if the
searches end at one error and no gain lies at the grid's edge.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax import Array
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from ventbench.base import compilation, files
from ventbench.base.arrays import Bools, Floats, batches
from ventbench.controllers.pid import PID
from ventbench.plants.catalog import SimulatorLike
from ventbench.plants.rigs import Rigs, load_rigs
from ventbench.task import draws as draw_tables
from ventbench.task import environment as env
from ventbench.task import protocol, rollouts
from ventbench.task.draws import Draws
from ventbench.task.environment import Scenario, nominal_scenario
from ventbench.task.interfaces import Plant
from ventbench.task.metrics.score import controllable_error
from ventbench.train.plants import ALL, TrainingPlants, check_names, plants_to_train_on

#: The paper's twenty values of P, I and D, %/cmH2O.
VALUES = (*(round(0.1 * i, 1) for i in range(10)), *(float(i) for i in range(1, 11)))

#: Gains that are run together.
BATCH = 2000

#: How many PIDs of each lung run on the draws.
FINALISTS = 100

#: Finalists that are run together: bounds memory.
TOGETHER = 20

#: Draws that gains are tuned on; none of them is ever scored.
TUNING = "tuning"
TUNING_SEED = hashlib.sha256(b"ventbench, draws for tuning").digest()


#: Files of a result in its folder.
TABLE, RESULT = "grid.parquet", "best.json"

#: Called with the number of trajectories done, and of all.
Progress = Callable[[int, int], None]

_GAINS = ["P", "I", "D"]


def paper_gains() -> Floats:
    """All combinations of :data:`VALUES`, P slowest, D fastest, shape ``(8000, 3)``."""
    return np.array(list(itertools.product(VALUES, VALUES, VALUES)))


@jax.jit
def _errors(plant: Plant, gains: Array, cells: Scenario) -> Array:
    cells = jax.tree.map(
        lambda x: jnp.broadcast_to(jnp.asarray(x, gains.dtype), (len(gains), *jnp.shape(x))), cells
    )
    controller = PID(gains[:, :1], gains[:, 1:2], gains[:, 2:])

    def record(before: env.LoopState, *_: Any) -> Array:
        return jnp.abs(before.signals.scored - cells.pip)

    policy, state = rollouts.controlled_by(controller), controller.init(cells.pip.shape)
    _, _, error = rollouts.inspiration(
        env.vary(plant, cells, 0), cells, policy, state, record=record
    )
    return error.mean(axis=0)


def errors(plants: Plant, gains: Floats) -> NDArray[np.float32]:
    """Nominal error of each PID on each lung at each PIP.

    Args:
        plants: leaves stacked over L lungs.
        gains: P, I and D, %/cmH2O, shape ``(G, 3)``.

    Returns:
        Mean ``|pressure - target|`` of an inspiration, cmH2O, shape ``(L, G, P)``; float32, which
        differs from the score by less than 1e-4.
    """
    lungs = jax.tree.leaves(plants)[0].shape[0]
    out = np.empty((lungs, len(gains), len(protocol.PIPS)), np.float32)
    cells = nominal_scenario(np.asarray(protocol.PIPS))
    for lung in range(lungs):
        plant = jax.tree.map(lambda x, lung=lung: jnp.asarray(x[lung], jnp.float32), plants)
        for index in batches(len(gains), min(BATCH, len(gains))):
            some = jnp.asarray(gains[index], jnp.float32)
            out[lung, index] = np.asarray(_errors(plant, some, cells))
    return out


@dataclass(frozen=True, eq=False)
class PIDGrid:
    """Errors of every PID."""

    lungs: tuple[str, ...]  #: ids, L of them.
    pips: tuple[float, ...]  #: cmH2O, N of them.
    gains: Floats  #: P, I and D, %/cmH2O, shape ``(G, 3)``.
    #: mean ``|pressure - PIP|`` of an inspiration, cmH2O, float32, shape ``(L, G, N)``.
    error: NDArray[np.float32]

    def __repr__(self) -> str:
        """Sizes."""
        lungs, gains, pips = self.error.shape
        return f"<PIDGrid of {lungs} lungs x {gains} gains x {pips} PIPs>"

    def best(self, lung: str | None = None) -> tuple[tuple[float, float, float], float]:
        """Gains with the lowest mean error on a lung, or over all lungs, and that error, cmH2O.

        The first in the order of the grid wins a tie.
        """
        error = self.error.mean(axis=-1, dtype=np.float64)
        mean = error.mean(axis=0) if lung is None else error[self.lungs.index(lung)]
        at = int(np.argmin(mean))
        P, I, D = self.gains[at].tolist()  # noqa: E741
        return (P, I, D), float(mean[at])

    def to_frame(self) -> pd.DataFrame:
        """One row a lung and PID: ``lung, P, I, D``, an error a PIP, and ``error``, their mean."""
        columns: dict[str, Any] = {
            "lung": np.repeat(self.lungs, len(self.gains)),
            **dict(zip(_GAINS, np.tile(self.gains, (len(self.lungs), 1)).T, strict=True)),
        }
        flat = self.error.reshape(-1, len(self.pips))
        columns |= {f"error_pip_{pip:g}": flat[:, n] for n, pip in enumerate(self.pips)}
        return pd.DataFrame(columns | {"error": flat.mean(axis=1)})

    def save(self, path: Path) -> None:
        """Write :meth:`to_frame` as Parquet, in one step."""
        table = self.to_frame()
        files.write_atomically(path, lambda file: table.to_parquet(file, index=False))


@jax.jit
def _pressures(plant: Plant, gains: Array, cells: Scenario) -> Array:
    def run(gains: Array) -> Array:
        return rollouts.closed_loop(plant, PID(*gains), cells)[0].pressure

    return jax.vmap(run)(gains)


def errors_on_draws(
    rigs: Rigs, rig_draws: Draws, lung: int, gains: Floats, *, together: int = TOGETHER
) -> Floats:
    """Error of PIDs on draws of one lung, without the first step.

    Args:
        rigs: that the draws are of.
        rig_draws: K draws.
        lung: index of the lung.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``.
        together: gains that are run together.

    Returns:
        Mean over the draws, cmH2O, shape ``(G, P)``.
    """
    plants, cells = rigs.cells(rig_draws, protocol.PIPS)
    plants_of_lung = jax.tree.map(lambda x: np.asarray(x)[lung], plants)
    if rigs.sessions is not None:  # without the nominal cells
        plants_of_lung = jax.tree.map(lambda x: x[1:], plants_of_lung)
    cell = jax.tree.map(lambda x: np.asarray(x)[lung, 1:], cells)
    out = np.empty((len(gains), cell.pip.shape[-1]))
    for index in batches(len(gains), together):
        with compilation.float64():
            arrays = jax.tree.map(jnp.asarray, (plants_of_lung, gains[index], cell))
            pressure = np.asarray(_pressures(*arrays))
        out[index] = controllable_error(pressure, cell.pip[..., None, None]).mean(axis=1)
    return out


def _tuning(
    lungs: Sequence[str] | None, simulator: SimulatorLike, each: bool
) -> tuple[TrainingPlants, dict[str, list[int]]]:
    """What PIDs are tuned on; and lungs that share a PID, by the lung's id or :data:`ALL`."""
    trained_on = plants_to_train_on(simulator)
    names = check_names(lungs, trained_on, all_lungs=False)
    where = {name: trained_on.names.index(name) for name in names}
    groups = {name: [at] for name, at in where.items()} if each else {}
    if len(names) > 1:
        groups[ALL] = list(where.values())
    return trained_on, groups


def _result(entries: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Entries of ``best.json`` of the groups of lungs."""
    lungs = {name: entry for name, entry in entries.items() if name != ALL}
    result: dict[str, Any] = {"lungs": lungs} if lungs else {}
    return result | ({"single": entries[ALL]} if ALL in entries else {})


def tune_pid(
    lungs: Sequence[str] | None = None,
    out: Path | str | None = None,
    *,
    gains: ArrayLike | None = None,
    draws: int = draw_tables.COUNT,
    each: bool = True,
    simulator: SimulatorLike = "frozen",
    progress: Progress = lambda completed, total: None,
) -> tuple[PIDGrid, dict[str, Any]]:
    """Run every PID of a grid on simulators without noise, the best on draws, and name the best.

    Neither the development draws nor the rigs that are held out have a part in the choice. What
    decides is the error weighted as in the normalised score: by the inverse of what there is to
    gain at a PIP of a lung.

    Args:
        lungs: ids; all lungs of the simulators if not given.
        out: folder for ``grid.parquet``, the whole grid, and ``best.json``, the result. Nothing is
            written if not given.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``; the paper's 8,000 if not given.
        draws: number of draws for tuning that decide among the :data:`FINALISTS` best; 0 to decide
            without noise, as in the paper.
        each: put the best gains of each lung into the result, beside those for all of several.
        simulator: simulators with plants of these lungs; see :func:`ventbench.load_simulators`. Of
            the frozen ones each lung has all its rigs but the held-out one.
        progress: see :data:`Progress`.

    Returns:
        The grid, of errors without noise, and the content of ``best.json``: the best gains and
        their errors without weights, on the draws without the first step if there are any.

    Raises:
        InputError: if a lung or a simulator is unknown.

    Examples:
        >>> from ventbench import tune_pid
        >>> gains = [(2.0, 4.0, 0.0), (5.0, 5.0, 0.0)]  # %/cmH2O
        >>> grid, result = tune_pid(["R20C50"], simulator="physics", gains=gains, draws=0)
        >>> result["lungs"]["R20C50"]["gains"]
        [2.0, 4.0, 0.0]
    """
    trained_on, groups = _tuning(lungs, simulator, each)
    names = check_names(lungs, trained_on, all_lungs=False)
    rigs, where = load_rigs(simulator).of_training, [*map(trained_on.names.index, names)]
    candidates = paper_gains() if gains is None else np.asarray(gains, float)
    trajectories = len(candidates) * len(protocol.PIPS)
    by_lung: dict[int, NDArray[np.float32]] = {}
    progress(0, len(where) * trajectories)
    for lung in where:
        sessions = rigs.sessions
        at = slice(lung, lung + 1) if sessions is None else (0, list(sessions[lung]))
        plants = jax.tree.map(lambda leaf, at=at: np.asarray(leaf)[at], rigs.plants)
        of_rigs = errors(plants, candidates)
        by_lung[lung] = of_rigs.mean(axis=0, dtype=np.float64).astype(np.float32)
        progress(len(by_lung) * trajectories, len(where) * trajectories)
    grid = PIDGrid(names, protocol.PIPS, candidates, np.stack([*by_lung.values()]))
    rig_draws = rigs.draws(draws, seed=TUNING_SEED, name=TUNING) if draws else None
    entries = {}
    for name, group in groups.items():
        weights = trained_on.weights[group]
        nominal = np.stack([by_lung[lung] for lung in group]).astype(float)
        order = np.argsort(np.einsum("lgp,lp->g", nominal, weights), kind="stable")
        finalists = order[: FINALISTS if draws else 1]
        error = nominal[:, finalists]
        if rig_draws is not None:
            some = candidates[finalists]
            error = np.stack([errors_on_draws(rigs, rig_draws, k, some) for k in group])
        best = int(np.argmin(np.einsum("lgp,lp->g", error, weights)))
        of_best = error[:, best].mean(axis=-1).tolist()
        gain = candidates[finalists[best]].tolist()
        entries[name] = {"gains": gain, "error": float(np.mean(of_best))}
        if name == ALL:
            entries[name]["lungs"] = dict(zip(names, of_best, strict=True))
    result = {
        "trajectories": int(grid.error.size),
        "pips": list(grid.pips),
        "draws": draws,
        **_result(entries),
        "simulators": dict(trained_on.about),
    }
    if out is not None:
        grid.save(Path(out) / TABLE)
        files.write_json(Path(out) / RESULT, result)
    return grid, result


#: Where searches may begin, %/cmH2O: P and I, and D.
START_P_I, START_D = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0), (0.1, 1.0, 10.0, 100.0)

#: Number of searches of each lung, their evaluations at most, and the first simplex, as a factor.
SEARCHES, EVALUATIONS, FACTOR = 3, 120, 1.5

#: Searches end when no vertex differs by more in a logarithm of a gain, or in error, cmH2O.
TOLERANCE, ERROR_TOLERANCE = 0.01, 1e-4

#: Significant digits of the result.
DIGITS = 3

#: Searches agree if their errors differ by less, cmH2O.
AGREEMENT = 0.02


@dataclass(frozen=True, eq=False)
class BestPIDs:
    """Best PIDs of L lungs, and of all together as one more where that was asked; S searches."""

    gains: Floats  #: P, I, D, %/cmH2O, shape ``(L, 3)``.
    #: weighted mean over draws and PIPs without the first step, cmH2O, shape ``(L,)``.
    error: Floats
    search_gains: Floats  #: where each search ended, shape ``(L, S, 3)``.
    search_errors: Floats  #: their errors, shape ``(L, S)``.

    @property
    def agree(self) -> Bools:
        """Whether at least two searches of a lung ended at one error, shape ``(L,)``."""
        ordered = np.sort(self.search_errors, axis=1)
        return ordered[:, 1] - ordered[:, 0] < AGREEMENT


def best_pids(
    rigs: Rigs,
    *,
    rig_draws: Draws | None = None,
    groups: Sequence[Sequence[int]] | None = None,
    weights: Floats | None = None,
    progress: Progress = lambda completed, total: None,
) -> BestPIDs:
    """Find the best PID of each lung on the rigs of the training.

    Args:
        rigs: lungs; what they hold out has no part.
        rig_draws: draws on the rigs of the training; the development draws if not given.
        groups: lungs that share a PID; each has its own if not given.
        weights: of the PIPs of each lung; equal if not given.
        progress: called with the number of groups done, and of all.
    """
    rigs = rigs.of_training
    rig_draws = rigs.draws(draw_tables.COUNT) if rig_draws is None else rig_draws
    groups = [[lung] for lung in range(len(rigs.lungs))] if groups is None else groups
    weight = np.ones(np.shape(rig_draws.cells.pip)[::2]) if weights is None else weights

    def mean_error(group: Sequence[int], rig_draws: Draws, gains: Floats, **options: int) -> Floats:
        per_lung = [
            errors_on_draws(rigs, rig_draws, at, gains, **options) * weight[at] for at in group
        ]
        return np.mean(per_lung, axis=(0, 2))

    few, ends = rig_draws.first(min(4, rig_draws.count)), []
    for completed, group in enumerate(groups):
        progress(completed, len(groups))
        starts = _starts(partial(mean_error, group, few))
        ends.append([_search(partial(mean_error, group, rig_draws, together=1), x) for x in starts])
    progress(len(groups), len(groups))
    best_gains = np.array([[gains for gains, _ in results] for results in ends])
    error = np.array([[error for _, error in results] for results in ends])
    at = (np.arange(len(groups)), np.argmin(error, axis=1))
    return BestPIDs(best_gains[at], error[at], best_gains, error)


def tune_beyond(
    lungs: Sequence[str] | None = None,
    *,
    draws: int = draw_tables.COUNT,
    each: bool = True,
    simulator: SimulatorLike = "frozen",
    progress: Progress = lambda completed, total: None,
) -> dict[str, Any]:
    """Tune PIDs as :func:`tune_pid` does, but without a grid's edge.

    Args:
        lungs: ids; all lungs of the simulators if not given.
        draws: number of draws for tuning, at least 1.
        each: find the best gains of each lung, beside those for all of several together.
        simulator: see :func:`ventbench.load_simulators`.
        progress: called with the number of PIDs found, and of all.

    Returns:
        The content of ``best.json``; errors are weighted.

    Raises:
        InputError: if a lung or a simulator is unknown, or there are no draws.
    """
    trained_on, groups = _tuning(lungs, simulator, each)
    rigs = load_rigs(simulator).of_training
    best_gains = best_pids(
        rigs,
        rig_draws=rigs.draws(draws, seed=TUNING_SEED, name=TUNING),
        groups=list(groups.values()),
        weights=trained_on.weights,
        progress=progress,
    )
    pairs = zip(best_gains.gains.tolist(), best_gains.error.tolist(), strict=True)
    entries = [{"gains": gains, "error": error} for gains, error in pairs]
    about = {"draws": draws, "simulators": dict(trained_on.about)}
    return about | _result(dict(zip(groups, entries, strict=True)))


def _starts(errors: Callable[[Floats], Floats]) -> list[Floats]:
    """Best points of the coarse grid, no two of them neighbours."""
    grid = np.array(list(itertools.product(START_P_I, START_P_I, START_D)))
    chosen: list[Floats] = []
    for gains in grid[np.argsort(errors(grid), kind="stable")]:
        if all(np.count_nonzero(gains != previous) > 1 for previous in chosen):
            chosen.append(gains)
    return chosen[:SEARCHES]


def _search(errors: Callable[[Floats], Floats], start: Floats) -> tuple[Floats, float]:
    """Gains where a search ends, and their error."""

    def error(logarithms: Floats) -> float:
        return float(errors(np.exp(logarithms)[None])[0])

    first = np.log(start)
    simplex = np.vstack([first, first + np.log(FACTOR) * np.eye(3)])
    options = {
        "initial_simplex": simplex,
        "maxfev": EVALUATIONS,
        "xatol": TOLERANCE,
        "fatol": ERROR_TOLERANCE,
    }
    optimum = minimize(error, first, method="Nelder-Mead", options=options).x
    gains = np.array([float(f"{gain:.{DIGITS - 1}e}") for gain in np.exp(optimum)])
    return gains, error(np.log(gains))
