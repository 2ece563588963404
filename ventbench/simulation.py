"""Valve commands from a file, and what a simulator answers to them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import precision, protocol
from ventbench.errors import InputError
from ventbench.interfaces import Plant
from ventbench.rollouts import open_loop

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Controls:
    """One sequence of commands; arrays of shape ``(T,)``.

    Attributes:
        time: s.
        u_in: inspiratory valve, %.
        u_out: expiratory valve, 0/1.
    """

    time: Floats
    u_in: Floats
    u_out: Floats

    @property
    def dt(self) -> Floats:
        """Time from each sample to the next, s, shape ``(T,)``; the last one is repeated."""
        steps = np.diff(self.time)
        return np.append(steps, steps[-1] if steps.size else protocol.DT)


def simulate(
    plant: Plant, controls: Controls, *, start: float = protocol.PEEP
) -> NDArray[np.float64]:
    """Pressures that a plant answers to commands with.

    Args:
        plant: any plant.
        controls: T commands.
        start: pressure at the first sample, cmH2O; the lung is at rest there.

    Returns:
        Pressure at each sample, cmH2O, shape ``(T,)``.
    """
    with precision.float64():
        commands = (jnp.asarray(x)[None] for x in (controls.u_in, controls.u_out, controls.dt))
        return np.asarray(open_loop(plant, jnp.asarray([float(start)]), *commands))[0]


def read_controls(path: Path) -> Controls:
    """Read a CSV file of commands.

    Args:
        path: header line and one row a sample; column ``u_in``, optionally ``u_out`` (0 if missing)
            and ``time_step`` in s (steps of 30 ms if missing); others are ignored, so that a
            recording of one breath is such a file too.

    Raises:
        InputError: if a column is missing or a value is wrong; it says which.
        OSError: if the file cannot be read.
    """
    import csv

    with open(path, newline="", encoding="utf-8-sig") as file:
        try:
            rows = list(csv.DictReader(file, strict=True))
        except (csv.Error, UnicodeDecodeError) as error:
            raise InputError(f"{path} is not a CSV file in UTF-8: {error}") from error
    if not rows or "u_in" not in rows[0]:
        raise InputError(f"{path} needs a header line with a column u_in, and at least one row")

    def column(name: str) -> Floats:
        return _numbers(path, name, [row[name] or "" for row in rows])

    u_in = column("u_in")
    u_out = column("u_out") if "u_out" in rows[0] else np.zeros(len(rows))
    time = column("time_step") if "time_step" in rows[0] else _steps(len(rows))
    out = (u_in < 0) | (u_in > protocol.U_MAX)
    _first(path, "u_in", out, u_in, "is outside 0..100 %. Fix the row.")
    _first(path, "u_out", (u_out != 0) & (u_out != 1), u_out, "is neither 0 nor 1. Fix the row.")
    back = np.append(False, np.diff(time) <= 0)
    _first(path, "time_step", back, time, "s is not later than the row before. Give one breath.")
    return Controls(time, u_in, u_out)


def _numbers(path: Path, column: str, text: list[str]) -> Floats:
    values = np.empty(len(text))
    for row, cell in enumerate(text):
        try:
            values[row] = float(cell)
        except ValueError:
            values[row] = np.nan
        if not np.isfinite(values[row]):
            raise InputError(
                f"{path} line {row + 2}, column {column}: {cell!r} is not a number. Fix the row."
            )
    return values


def _first(path: Path, column: str, bad: NDArray[np.bool_], values: Floats, why: str) -> None:
    if np.any(bad):
        row = int(np.argmax(bad))
        raise InputError(f"{path} line {row + 2}, column {column}: {values[row]:g} {why}")


def _steps(count: int) -> Floats:
    return np.arange(count, dtype=np.float64) * protocol.DT
