"""The exhaustive search for PID gains: every PID of the paper's grid on every lung and PIP.

Without noise each breath of a run is the same, as each begins at rest and the PID starts anew, so
one inspiration stands for all. The search is dealt out in parts, which run in this process, in
others or on a cluster; a finished part is never computed twice.
"""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
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

from ventbench import environment as env
from ventbench import files, protocol
from ventbench.controllers.pid import PID
from ventbench.environment import Scenario, nominal_scenario
from ventbench.errors import InputError
from ventbench.executor import InProcess, executor, results
from ventbench.interfaces import Plant
from ventbench.plants.catalog import Given, load_simulators
from ventbench.resume import ARRAY, WorkFolder, fingerprint

#: The paper's twenty values of P, I and D, %/cmH2O.
VALUES = (*(round(0.1 * i, 1) for i in range(10)), *(float(i) for i in range(1, 11)))

#: Gains that are run together.
BATCH = 2000

#: Files of a search in its folder.
TABLE, RESULT, PARTS = "grid.parquet", "best.json", "parts"

#: Called with the number of trajectories done, and of all.
Progress = Callable[[int, int], None]

_GAINS = ["P", "I", "D"]


def paper_gains() -> NDArray[np.float64]:
    """All combinations of :data:`VALUES`, P slowest, D fastest, shape ``(8000, 3)``."""
    return np.array(list(itertools.product(VALUES, VALUES, VALUES)))


@partial(jax.jit, static_argnames="airway")
def _errors(plant: Plant, gains: Array, cells: Scenario, airway: bool = False) -> Array:
    cells = jax.tree.map(
        lambda x: jnp.broadcast_to(jnp.asarray(x, gains.dtype), (len(gains), *jnp.shape(x))), cells
    )
    controller = PID(gains[:, :1], gains[:, 1:2], gains[:, 2:])
    varied = env.vary(plant, cells)

    def step(carry: tuple[env.LoopState, Any, Array], index: Array) -> tuple[Any, None]:
        loop, state, total = carry
        pressure = env.airway_pressure(varied, loop) if airway else loop.pressure
        total = total + jnp.abs(pressure - cells.pip)
        state, requested = controller.step(state, env.observe(cells, loop, 0, index))
        loop, _ = env.inspire(varied, cells, loop, requested)
        return (loop, state, total), None

    start = env.start_breath(varied, cells)
    carry = (start, controller.init(start.pressure.shape), jnp.zeros_like(start.pressure))
    (_, _, total), _ = jax.lax.scan(step, carry, jnp.arange(protocol.INSPIRATION_STEPS))
    return total / protocol.INSPIRATION_STEPS


def errors(
    plants: Plant,
    gains: NDArray[np.float64],
    pips: tuple[float, ...] = protocol.PIPS,
    batch: int = BATCH,
    *,
    airway: bool = False,
) -> NDArray[np.float32]:
    """Nominal error of each PID on each lung at each PIP.

    Args:
        plants: leaves stacked over L lungs.
        gains: P, I and D, %/cmH2O, shape ``(G, 3)``.
        pips: cmH2O, P of them.
        batch: gains that are run together.
        airway: take the error of the airway pressure (protocol version 2), not of the reading.

    Returns:
        Mean ``|pressure - target|`` of an inspiration, cmH2O, shape ``(L, G, P)``; float32, which
        differs from the score by less than 1e-4.
    """
    lungs = jax.tree.leaves(plants)[0].shape[0]
    count = len(gains)
    out = np.empty((lungs, count, len(pips)), np.float32)
    cells = nominal_scenario(np.asarray(pips))
    batch = min(batch, count)
    for lung in range(lungs):
        plant = jax.tree.map(lambda x, lung=lung: jnp.asarray(x[lung], jnp.float32), plants)
        for first in range(0, count, batch):
            # The last batch is padded with the last gains, so that all compile once.
            index = np.minimum(np.arange(first, first + batch), count - 1)
            some = jnp.asarray(gains[index], jnp.float32)
            out[lung, index] = np.asarray(_errors(plant, some, cells, airway))
    return out


@dataclass(frozen=True, eq=False)
class PIDGrid:
    """Errors of every PID.

    Attributes:
        lungs: ids, L of them.
        pips: cmH2O, N of them.
        gains: P, I and D, %/cmH2O, shape ``(G, 3)``.
        error: mean ``|pressure - PIP|`` of an inspiration, cmH2O, float32, shape ``(L, G, N)``.
    """

    lungs: tuple[str, ...]
    pips: tuple[float, ...]
    gains: NDArray[np.float64]
    error: NDArray[np.float32]

    def best(self, lung: str | None = None) -> tuple[tuple[float, float, float], float]:
        """Gains with the lowest mean error on a lung, or over all lungs, and that error, cmH2O.

        The first in the order of the grid wins a tie.
        """
        error = self.error.mean(axis=-1, dtype=np.float64)
        mean = error.mean(axis=0) if lung is None else error[self.lungs.index(lung)]
        at = int(np.argmin(mean))
        P, I, D = self.gains[at].tolist()  # noqa: E741
        return (P, I, D), float(mean[at])

    def summary(self, *, each: bool = True, single: bool = True) -> dict[str, Any]:
        """Best gains and their errors, as JSON values.

        Args:
            each: the best gains of each lung.
            single: the best gains for all lungs together.
        """
        result: dict[str, Any] = {
            "trajectories": int(self.error.size),
            "pips": list(self.pips),
        }

        def entry(lung: str | None) -> dict[str, Any]:
            gains, error = self.best(lung)
            return {"gains": list(gains), "error": error}

        if each:
            result["lungs"] = {lung: entry(lung) for lung in self.lungs}
        if single:
            at = entry(None)
            index = int(np.flatnonzero(np.all(self.gains == at["gains"], axis=1))[0])
            on_each = self.error[:, index].mean(axis=-1, dtype=np.float64)
            at["lungs"] = dict(zip(self.lungs, on_each.tolist(), strict=True))
            result["single"] = at
        return result

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


def load_grid(path: Path) -> PIDGrid:
    """Read what :meth:`PIDGrid.save` wrote.

    Raises:
        InputError: if it is not such a table.
        OSError: if it cannot be read.
    """
    try:
        table = pd.read_parquet(path)
        lungs = tuple(dict.fromkeys(table["lung"]))
        names = [name for name in table.columns if name.startswith("error_pip_")]
        pips = tuple(float(name.removeprefix("error_pip_")) for name in names)
        gains = table[_GAINS].to_numpy(float)[: len(table) // len(lungs)]
        error = table[names].to_numpy(np.float32).reshape(len(lungs), len(gains), len(pips))
    except (KeyError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"{path} is not a table of `ventbench tune pid`: {error}") from error
    return PIDGrid(lungs, pips, gains, error)


def tune_pid(
    lungs: Sequence[str] | None = None,
    out: Path | str | None = None,
    *,
    gains: ArrayLike | None = None,
    workers: int = 0,
    scheduler: str | None = None,
    each: bool = True,
    single: bool | None = None,
    simulator: Given = "frozen",
    progress: Progress | None = None,
) -> tuple[PIDGrid, dict[str, Any]]:
    """Run every PID of a grid on simulators without noise, and name the best gains.

    Args:
        lungs: ids; all lungs of the simulators if not given.
        out: folder for ``grid.parquet``, the whole grid, and ``best.json``, the result; parts of an
            interrupted search lie there too, and the same call continues from them. Nothing is
            written if not given.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``; the paper's 8,000 if not given.
        workers: processes; 0 for this one alone, which uses all cores.
        scheduler: address of a Dask scheduler instead, such as ``tcp://host:8786``.
        each: put the best gains of each lung into the result.
        single: put the best gains for all lungs together into the result; if not given, where there
            are several lungs.
        simulator: simulators with plants of these lungs; see :func:`ventbench.load_simulators`.
        progress: see :data:`Progress`.

    Returns:
        The grid, and the content of ``best.json``: see :meth:`PIDGrid.summary`.

    Raises:
        InputError: if a lung or a simulator is unknown, ``out`` holds an unfinished search with
            other settings, or a worker died.

    Examples:
        >>> from ventbench import tune_pid
        >>> gains = [(2.0, 4.0, 0.0), (5.0, 5.0, 0.0)]  # %/cmH2O
        >>> grid, result = tune_pid(["R20C50"], simulator="physics", gains=gains)
        >>> grid.best("R20C50")[0]
        (2.0, 4.0, 0.0)
    """
    simulators = load_simulators(simulator)
    names = tuple(entry.id for entry in simulators.lungs) if lungs is None else tuple(lungs)
    plants = {name: simulators.plant(name) for name in names}
    parts = None if out is None else Path(out) / PARTS
    with executor(workers, scheduler) as pool:
        grid = search(
            plants,
            settings=dict(simulators.about),
            folder=parts,
            gains=None if gains is None else np.asarray(gains, float),
            pool=pool,
            progress=progress,
        )
    result = grid.summary(each=each, single=len(names) > 1 if single is None else single)
    result["simulators"] = dict(simulators.about)
    if out is not None:
        grid.save(Path(out) / TABLE)
        files.write_json(Path(out) / RESULT, result)
        shutil.rmtree(Path(out) / PARTS)
    return grid, result


def search(
    plants: Mapping[str, Plant],
    *,
    settings: Mapping[str, Any],
    folder: Path | None = None,
    gains: NDArray[np.float64] | None = None,
    pool: Executor | None = None,
    part: int = BATCH,
    progress: Progress | None = None,
    errors_of: Callable[[Plant, NDArray[np.float64]], NDArray[np.float32]] | None = None,
) -> PIDGrid:
    """Run the grid of gains on plants without noise.

    Args:
        plants: one plant a lung, by its id.
        settings: JSON values that identify the plants.
        folder: folder in which finished parts are kept, so that an interrupted search continues;
            nowhere if not given.
        gains: P, I and D, shape ``(G, 3)``; the paper's if not given.
        pool: executor that computes the parts; this process if not given.
        part: gains of a part.
        progress: see :data:`Progress`.
        errors_of: computes a part: errors of gains on one plant, shape ``(g, N)``; by
            :func:`errors` if not given.

    Raises:
        InputError: if the folder holds parts of another search, or a worker died.
    """
    grid = paper_gains() if gains is None else gains
    firsts = range(0, len(grid), part)
    total = len(plants) * len(grid) * len(protocol.PIPS)
    about = {"simulators": dict(settings), "gains": fingerprint(grid), "part": part}
    work = None if folder is None else WorkFolder(folder, about)
    finished: dict[str, NDArray[np.float32]] = {}
    jobs = {}
    for lung, plant in plants.items():
        plain = jax.tree.map(np.asarray, plant)
        for first in firsts:
            name, some = f"{lung}-{first}", grid[first : first + part]
            if work is not None and work.has(name, ARRAY):
                finished[name] = _read_part(work, name, len(some))
            else:
                jobs[name] = (plain, some)
    done = sum(error.size for error in finished.values())
    report = progress or (lambda done, total: None)
    report(done, total)
    for name, error in results(pool or InProcess(), errors_of or _part_errors, jobs):
        if name in finished:
            raise RuntimeError(f"part {name} came back twice")
        finished[name] = error
        if work is not None:
            work.put(name, error, ARRAY)
        done += error.size
        report(done, total)
    error = np.stack(
        [np.concatenate([finished[f"{lung}-{first}"] for first in firsts]) for lung in plants]
    )
    return PIDGrid(tuple(plants), protocol.PIPS, grid, error)


def _part_errors(plant: Plant, gains: NDArray[np.float64]) -> NDArray[np.float32]:
    stacked = jax.tree.map(lambda leaf: np.asarray(leaf)[None], plant)
    return errors(stacked, gains)[0]


def _read_part(work: WorkFolder, name: str, gains: int) -> NDArray[np.float32]:
    error, shape = work.read(name, ARRAY), (gains, len(protocol.PIPS))
    if error.shape != shape or error.dtype != np.float32:
        path = work.path(name, ARRAY)
        raise InputError(f"{path} holds {error.dtype} {error.shape}, not float32 {shape}")
    return error
