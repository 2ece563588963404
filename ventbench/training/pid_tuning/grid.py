"""Every gain on every lung, dealt out in parts; a finished part is never computed twice."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ventbench import protocol
from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.resume import ARRAY, WorkFolder, fingerprint
from ventbench.training import pid_grid
from ventbench.training.executor import InProcess, results

#: Gains of a part.
PART = pid_grid.BATCH


@dataclass(frozen=True, eq=False)
class Grid:
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


def tune(
    plants: Mapping[str, Plant],
    *,
    identity: Mapping[str, Any],
    folder: Path | None = None,
    gains: NDArray[np.float64] | None = None,
    pool: Executor | None = None,
    part: int = PART,
    progress: Callable[[int, int], None] | None = None,
) -> Grid:
    """Run the grid of gains on lungs without noise.

    Args:
        plants: one plant a lung, by its id.
        identity: JSON values that tell which simulators these are.
        folder: where finished parts are kept until all are, so that an interrupted search goes on;
            nowhere if not given.
        gains: P, I and D, shape ``(G, 3)``; the paper's if not given.
        pool: where the parts are computed; here if not given.
        part: gains of a part.
        progress: called with the number of trajectories done, and of all.

    Raises:
        InputError: if the folder holds parts of another search, or a worker died.
    """
    gains = pid_grid.gains() if gains is None else gains
    firsts = range(0, len(gains), part)
    total = len(plants) * len(gains) * len(protocol.PIPS)
    about = {"simulators": dict(identity), "gains": fingerprint(gains), "part": part}
    work = None if folder is None else WorkFolder(folder, about)
    found: dict[str, NDArray[np.float32]] = {}
    jobs = {}
    for lung, plant in plants.items():
        plain = jax.tree.map(np.asarray, plant)
        for first in firsts:
            name, some = f"{lung}-{first}", gains[first : first + part]
            if work is not None and work.has(name, ARRAY):
                found[name] = _finished(work, name, len(some))
            else:
                jobs[name] = (plain, some)
    done = sum(error.size for error in found.values())
    report = progress or (lambda done, total: None)
    report(done, total)
    for name, error in results(pool or InProcess(), errors, jobs):
        if name in found:
            raise RuntimeError(f"part {name} came back twice")
        found[name] = error
        if work is not None:
            work.put(name, error, ARRAY)
        done += error.size
        report(done, total)
    error = np.stack(
        [np.concatenate([found[f"{lung}-{first}"] for first in firsts]) for lung in plants]
    )
    return Grid(tuple(plants), protocol.PIPS, gains, error)


def errors(plant: Plant, gains: NDArray[np.float64]) -> NDArray[np.float32]:
    """One part: errors of gains on one lung, shape ``(g, N)``."""
    stacked = jax.tree.map(lambda leaf: np.asarray(leaf)[None], plant)
    return pid_grid.errors(stacked, gains)[0]


def _finished(work: WorkFolder, name: str, gains: int) -> NDArray[np.float32]:
    error, shape = work.read(name, ARRAY), (gains, len(protocol.PIPS))
    if error.shape != shape or error.dtype != np.float32:
        path = work.path(name, ARRAY)
        raise InputError(f"{path} holds {error.dtype} {error.shape}, not float32 {shape}")
    return error
