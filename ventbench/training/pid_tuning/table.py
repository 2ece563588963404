"""The grid as a table, and what it says: the best gains of each lung, and of all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ventbench import files
from ventbench.errors import InputError
from ventbench.training.pid_tuning.grid import Grid

_GAINS = ["P", "I", "D"]


def frame(grid: Grid) -> pd.DataFrame:
    """One row a lung and PID: ``lung, P, I, D``, an error a PIP, and ``error``, their mean."""
    columns: dict[str, Any] = {
        "lung": np.repeat(grid.lungs, len(grid.gains)),
        **dict(zip(_GAINS, np.tile(grid.gains, (len(grid.lungs), 1)).T, strict=True)),
    }
    flat = grid.error.reshape(-1, len(grid.pips))
    columns |= {_column(pip): flat[:, n] for n, pip in enumerate(grid.pips)}
    return pd.DataFrame(columns | {"error": flat.mean(axis=1)})


def write(path: Path, grid: Grid) -> None:
    """Write the table as Parquet, in one step."""
    table = frame(grid)
    files.write_atomically(path, lambda file: table.to_parquet(file, index=False))


def read(path: Path) -> Grid:
    """Read what :func:`write` wrote.

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
    return Grid(lungs, pips, gains, error)


def best_gains(grid: Grid, lung: str | None = None) -> tuple[tuple[float, float, float], float]:
    """Gains with the lowest mean error on a lung, or over all lungs of the grid, and that error.

    The first in the order of the grid wins a tie.
    """
    error = grid.error.mean(axis=-1, dtype=np.float64)
    mean = error.mean(axis=0) if lung is None else error[grid.lungs.index(lung)]
    at = int(np.argmin(mean))
    P, I, D = grid.gains[at].tolist()  # noqa: E741
    return (P, I, D), float(mean[at])


def summary(grid: Grid, *, each: bool = True, single: bool = True) -> dict[str, Any]:
    """What the grid says, as JSON values.

    Args:
        grid: of one lung or more.
        each: the best gains of each lung.
        single: the best gains for all lungs together.
    """
    result: dict[str, Any] = {
        "trajectories": int(grid.error.size),
        "pips": list(grid.pips),
    }

    def entry(lung: str | None) -> dict[str, Any]:
        gains, error = best_gains(grid, lung)
        return {"gains": list(gains), "error": error}

    if each:
        result["lungs"] = {lung: entry(lung) for lung in grid.lungs}
    if single:
        at = entry(None)
        index = int(np.flatnonzero(np.all(grid.gains == at["gains"], axis=1))[0])
        on_each = grid.error[:, index].mean(axis=-1, dtype=np.float64)
        at["lungs"] = dict(zip(grid.lungs, on_each.tolist(), strict=True))
        result["single"] = at
    return result


def _column(pip: float) -> str:
    return f"error_pip_{pip:g}"
