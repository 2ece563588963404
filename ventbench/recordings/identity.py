"""Identity of a breath: whether a recording holds a breath that somebody has seen, exported again.

A breath is its lung, its first :data:`SAMPLES` inspiratory commands and the pressures beside them.
Its fingerprint tells it again without keeping it: the values are cut into cells of width
:data:`CELL` on three grids, a third of a cell apart, and the cells of each grid are hashed. A copy
with fewer digits may lie in the next cell, but by no more than :data:`TOLERANCE`, and as the grids
are more than twice as far apart, each value is near an edge of one grid at most. So a copy is
looked up on the grid on which fewest of its values are near an edge, under every way in which
those could have been cut: at most 2^(SAMPLES / 3) ways. A copy is never missed, and a match means
that all values agree to ``CELL + TOLERANCE``.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable
from dataclasses import dataclass, fields
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.recordings.breaths import Breaths

Keys = NDArray[np.uint64]

#: Inspiratory samples that count; what follows may be missing from a copy.
SAMPLES = 20

#: Width of a cell, and the most that a copy may be off: two decimals, rounded twice; % and cmH2O.
CELL, TOLERANCE = 0.04, 0.006

#: Edges of the grids, in cells; 0 and 100 %, where valves rest, are near none of them.
_GRIDS = (1 / 6, 1 / 2, 5 / 6)

#: Cell of a blank, and of a sample that a short inspiration does not have.
_BLANK, _NONE = -(2**31), -(2**31) + 1


@dataclass(frozen=True)
class Fingerprints:
    """Fingerprints of n breaths; one column a grid."""

    commands: Keys  #: of lung and commands, ``(n, 3)``.
    pressures: Keys  #: of the pressures, ``(n, 3)``.
    measured: Bools  #: whether no pressure among them is blank, ``(n,)``.

    def select(self, which: Ints) -> Fingerprints:
        """Return those of some of the breaths."""
        return Fingerprints(*(getattr(self, field.name)[which] for field in fields(self)))


@dataclass(frozen=True)
class Matches:
    """Which known breath each of n breaths is."""

    known: Ints  #: index of the known breath, -1 if it is none, ``(n,)``.
    #: whether the pressures agree too; without, they are blank in one of the two, and the breath is
    #: perhaps a copy, ``(n,)``.
    certain: Bools


def fingerprints(breaths: Breaths) -> Fingerprints:
    """Fingerprints to keep of breaths."""
    lungs, u_in, pressure = breaths.lung_ids.tolist(), *_values(breaths)
    names = ("",) * len(lungs)
    keys = [
        np.array(
            [
                [_key(name, grid, cells) for grid, cells in enumerate(grid_cells)]
                for name, grid_cells in zip(of, _cut(values)[0], strict=True)
            ],
            np.uint64,
        ).reshape(-1, len(_GRIDS))
        for of, values in ((lungs, u_in), (names, pressure))
    ]
    return Fingerprints(keys[0], keys[1], _measured(pressure))


def match(breaths: Breaths, references: Fingerprints) -> Matches:
    """Look breaths up among known ones.

    Breaths with the same commands and other measured pressures are repeats, not copies.
    """
    rows: list[dict[int, list[int]]] = [{} for _ in _GRIDS]
    for grid, table in enumerate(rows):
        for row, key in enumerate(references.commands[:, grid].tolist()):
            table.setdefault(key, []).append(row)
    rows_found = np.full(len(breaths), -1, np.int64)
    certain = np.zeros(len(breaths), bool)
    lungs, u_in, pressure = breaths.lung_ids.tolist(), *_values(breaths)
    commands, pressures = _cut(u_in), _cut(pressure)
    measured = _measured(pressure)
    for i, lung in enumerate(lungs):
        grid, keys = _possible(lung, commands[0][i], commands[1][i])
        like = sorted({row for key in keys for row in rows[grid].get(key, ())})
        if not like:
            continue
        grid, keys = _possible("", pressures[0][i], pressures[1][i])
        possible = set(keys)
        same = [row for row in like if int(references.pressures[row, grid]) in possible]
        perhaps = [row for row in like if not (measured[i] and references.measured[row])]
        if same or perhaps:
            rows_found[i], certain[i] = (same or perhaps)[0], bool(same)
    return Matches(rows_found, certain)


def repetitions(breaths: Breaths) -> tuple[Ints, Ints]:
    """Find breaths that are there more than once.

    Returns:
        For each breath the first one, in their order, of which it is a copy or perhaps one, and the
        first one with the same commands, whatever its pressures: they are itself where there is
        none, ``(n,)`` each.
    """
    prints = fingerprints(breaths)
    anyhow = Fingerprints(
        prints.commands, np.zeros_like(prints.pressures), np.zeros_like(prints.measured)
    )
    copy, repeat = np.arange(len(breaths)), match(breaths, anyhow).known
    for i in np.flatnonzero(repeat != copy):
        repeat[i] = repeat[repeat[i]]
        earlier = np.flatnonzero(repeat[:i] == repeat[i])
        row = int(match(breaths.select(np.array([i])), prints.select(earlier)).known[0])
        if row >= 0:
            copy[i] = copy[earlier[row]]
    return copy, repeat


def _values(breaths: Breaths) -> list[Floats]:
    """The first commands and pressures, ``(n, SAMPLES)`` each; infinite where there is none."""
    some = min(SAMPLES, breaths.inspiratory.shape[1])
    at = np.argsort(~breaths.inspiratory, axis=1, kind="stable")[:, :some]
    out = []
    for values in (breaths.u_in, breaths.pressure):
        first = np.full((len(breaths), SAMPLES), np.inf)
        there = np.take_along_axis(breaths.inspiratory, at, axis=1)
        first[:, :some] = np.where(there, np.take_along_axis(values, at, axis=1), np.inf)
        out.append(first)
    return out


def _measured(pressure: Floats) -> Bools:
    return np.count_nonzero(np.isnan(pressure), axis=1) == 0


def _cut(values: Floats) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Cells of values ``(n, SAMPLES)`` on each grid, ``(n, 3, SAMPLES)``.

    Also the neighbour that each value may have come from: -1, 0 or 1.
    """
    scaled = np.nan_to_num(values, posinf=0.0)[:, None] / CELL + np.array(_GRIDS)[:, None]
    cells = np.floor(scaled)
    inside, margin = scaled - cells, TOLERANCE / CELL + 1e-9
    neighbour = (inside > 1.0 - margin).astype(np.int8) - (inside < margin).astype(np.int8)
    cells = np.clip(cells, -(2**30), 2**30).astype("<i4")
    values = np.broadcast_to(values[:, None], cells.shape)
    cells = np.where(np.isnan(values), _BLANK, np.where(np.isinf(values), _NONE, cells))
    return cells.astype("<i4"), np.where(np.isfinite(values), neighbour, 0)


def _possible(
    name: str, cells: NDArray[np.int32], neighbour: NDArray[np.int8]
) -> tuple[int, list[int]]:
    """The grid with fewest values near an edge, and every key that the original may have there."""
    grid = int(np.argmin(np.count_nonzero(neighbour, axis=1)))
    central, shift = cells[grid].tolist(), neighbour[grid].tolist()
    ways = [(cell, cell + by) if by else (cell,) for cell, by in zip(central, shift, strict=True)]
    return grid, [_key(name, grid, combination) for combination in product(*ways)]


_PACK = struct.Struct(f"<{SAMPLES}i").pack


def _key(name: str, grid: int, cells: Iterable[int]) -> int:
    digest = hashlib.sha256(f"{name}:{grid}:".encode() + _PACK(*cells)).digest()
    return int.from_bytes(digest[:8], "little")
