"""Breaths that a diagnosis requests: their files, and their recording on the concealed rig."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hardware_eval.emulation.cases import random_generator
from proofs.challenge.folder import ChallengeFolder
from proofs.challenge.generators import generator_of
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import join
from ventbench.recordings.read import load
from ventbench.recordings.write import write as write_recording

Floats = NDArray[np.float64]

_COLUMNS = ("breath_id", "time_step", "u_in", "u_out")


class Commands(Protocol):
    """Requested breaths, as a diagnosis states them; all ``(k, T)``."""

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
        """Time to the next sample, s."""
        ...


@dataclass(frozen=True, eq=False)
class Request:
    """Requested breaths, as read from a file.

    Attributes:
        time: times of the samples from the breath's first, s, ``(k, T)``.
        u_in: inspiratory valve, %, ``(k, T)``.
        u_out: expiratory valve, 0/1, ``(k, T)``.
    """

    time: Floats
    u_in: Floats
    u_out: NDArray[np.int8]


def write(path: Path, requested: Commands, first: int) -> None:
    """Write a request; its breaths have the numbers from ``first`` on."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(_COLUMNS)
    time = np.cumsum(np.pad(requested.dt[:, :-1], ((0, 0), (1, 0))), axis=1)
    for i in range(len(time)):
        for t, u_in, u_out in zip(time[i], requested.u_in[i], requested.u_out[i], strict=True):
            rows.writerow((first + i, round(float(t), 6), round(float(u_in), 6), int(u_out)))
    files.write_text(path, text.getvalue())


def read(path: Path) -> Request:
    """Read a request.

    Raises:
        InputError: if the file is not a request.
    """
    with open(path, newline="") as file:
        lines = list(csv.reader(file))
    if not lines or tuple(lines[0]) != _COLUMNS:
        raise InputError(f"{path}: the columns must be {','.join(_COLUMNS)}")
    try:
        table = np.array([[float(cell) for cell in row] for row in lines[1:]])
        ids, counts = np.unique(table[:, 0], return_counts=True)
        time, u_in, u_out = (table[:, k].reshape(len(ids), int(counts[0])) for k in (1, 2, 3))
    except (ValueError, IndexError) as error:
        raise InputError(
            f"{path}: not a table of numbers with breaths of equal length: {error}"
        ) from error
    if not (np.all((u_in >= 0) & (u_in <= 100)) and np.all(np.diff(time, axis=1) > 0)):
        raise InputError(f"{path}: u_in must be 0..100 % and time must rise within each breath")
    return Request(time, u_in, (u_out > 0.5).astype(np.int8))


def record(folder: ChallengeFolder, secret: str) -> list[str]:
    """Record the requested breaths, each on its own rig, and append them to the first recording.

    Args:
        folder: first round of a challenge.
        secret: secret of the challenge.

    Returns:
        Names of the cases with a request.

    Raises:
        InputError: if the secret is another one, or a request cannot be read.
    """
    second, names = ChallengeFolder(folder.path, 2), []
    for drawn, _ in folder.truth(secret):
        case = drawn.case
        path = folder.request(case.name)
        if path.is_file():
            requested = read(path)
            rng = random_generator(secret, "second recording", case.name)
            record_commands = generator_of(case).record_commands
            more = record_commands(case, requested.time, requested.u_in, requested.u_out, rng)
            both = join([load(folder.recording(case.name)), more])
            write_recording(both, second.recording(case.name))
            names.append(case.name)
    return names
