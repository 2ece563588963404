"""What happened in a scored run: arrays over lungs, PIPs and time, and their file."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ventbench import files
from ventbench.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectories:
    """Nominal trajectories of one submission; shapes with L lungs, P PIPs, T = 300 steps.

    Attributes:
        name: of the submission.
        track: ``"performance"`` or ``"robustness"``.
        lungs: lung ids, length L.
        pips: cmH2O, length P.
        time: since the start of the run, s, shape ``(T,)``.
        target: target pressure, cmH2O, shape ``(L, P, T)``.
        pressure: true airway pressure, cmH2O, likewise.
        u_in: inspiratory valve as applied, %, likewise.
        u_out: expiratory valve, 0/1, likewise.
    """

    name: str
    track: str
    lungs: tuple[str, ...]
    pips: tuple[float, ...]
    time: Floats
    target: Floats
    pressure: Floats
    u_in: Floats
    u_out: Floats

    def save(self, path: Path) -> None:
        """Write an ``.npz`` file in one step."""
        arrays = {
            "name": np.array(self.name),
            "track": np.array(self.track),
            "lungs": np.array(self.lungs),
            "pips": np.array(self.pips),
            "time": self.time,
            "target": self.target,
            "pressure": self.pressure,
            "u_in": self.u_in,
            "u_out": self.u_out,
        }
        files.write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def load(path: Path) -> Trajectories:
    """Read what :meth:`Trajectories.save` wrote.

    Raises:
        InputError: if the file is not such a file.
        OSError: if it cannot be read.
    """
    try:
        # Opened here: np.load leaves a file open that it cannot make sense of.
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as npz:
            return Trajectories(
                name=str(npz["name"]),
                track=str(npz["track"]),
                lungs=tuple(str(x) for x in npz["lungs"]),
                pips=tuple(float(x) for x in npz["pips"]),
                **{k: npz[k] for k in ("time", "target", "pressure", "u_in", "u_out")},
            )
    # What np.load raises for a text, an empty or cut-off file, and for a plain array (TypeError).
    except (KeyError, ValueError, EOFError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} is not a trajectory file of ventbench: {error}") from error
