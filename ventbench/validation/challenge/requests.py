"""Breaths that a diagnosis asks for, as a file, and what the concealed rig answers."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ventbench import files
from ventbench.errors import InputError
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.join import join
from ventbench.recordings.read import load
from ventbench.recordings.write import write as write_recording
from ventbench.validation.challenge import seal
from ventbench.validation.challenge.cases import Case
from ventbench.validation.challenge.folder import Folder
from ventbench.validation.challenge.rig import record_commands

Floats = NDArray[np.float64]

_COLUMNS = ("breath_id", "time_step", "u_in", "u_out")


class Commands(Protocol):
    """What is asked for; all ``(k, T)``."""

    @property
    def u_in(self) -> Floats:
        """Inspiratory valve, %."""
        ...

    @property
    def u_out(self) -> Floats:
        """Expiratory valve, 0/1."""
        ...

    @property
    def dt(self) -> Floats:
        """To the next sample, s."""
        ...


@dataclass(frozen=True, eq=False)
class Asked:
    """Breaths of a request; ``(k, T)`` each: s, %, 0/1."""

    time: Floats
    u_in: Floats
    u_out: NDArray[np.int8]


def write(path: Path, asked: Commands, first: int) -> None:
    """Write a request; breaths are numbered on from ``first``."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(_COLUMNS)
    time = np.cumsum(np.pad(asked.dt[:, :-1], ((0, 0), (1, 0))), axis=1)
    for i in range(len(time)):
        for t, u_in, u_out in zip(time[i], asked.u_in[i], asked.u_out[i], strict=True):
            rows.writerow((first + i, round(float(t), 6), round(float(u_in), 6), int(u_out)))
    files.write_text(path, text.getvalue())


def read(path: Path) -> Asked:
    """Read a request.

    Raises:
        InputError: if the file is not one.
    """
    with open(path, newline="") as file:
        lines = list(csv.reader(file))
    if not lines or tuple(lines[0]) != _COLUMNS:
        raise InputError(f"{path}: the columns must be {','.join(_COLUMNS)}")
    try:
        table = np.array([[float(x) for x in row] for row in lines[1:]])
        ids, counts = np.unique(table[:, 0], return_counts=True)
        time, u_in, u_out = (table[:, k].reshape(len(ids), int(counts[0])) for k in (1, 2, 3))
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{path}: not a table of numbers with breaths of equal length: {error}"
        ) from error
    if not (np.all((u_in >= 0) & (u_in <= 100)) and np.all(np.diff(time, axis=1) > 0)):
        raise InputError(f"{path}: u_in must be 0..100 % and time must rise within each breath")
    return Asked(time, u_in, (u_out > 0.5).astype(np.int8))


def record(folder: Folder, secret: str) -> list[str]:
    """Record what was asked for, each on its own rig, behind the recording that is there.

    Args:
        folder: first round of a challenge.
        secret: of it.

    Returns:
        Names of the cases.

    Raises:
        InputError: if the secret is another one, or a request cannot be read.
    """
    second, names = Folder(folder.path, 2), []
    for drawn, _ in folder.truth(secret):
        case = drawn.case
        path = folder.request(case.name)
        if path.is_file():
            more = _answered(case, read(path), secret)
            write_recording(
                join([load(folder.recording(case.name)), more]), second.recording(case.name)
            )
            names.append(case.name)
    return names


def _answered(case: Case, asked: Asked, secret: str) -> Breaths:
    rng = seal.generator(secret, "second recording", case.name)
    return record_commands(case, asked.time, asked.u_in, asked.u_out, rng)
