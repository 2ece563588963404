"""Recordings of rigs for a training: every file of a folder, each breath once, folds, labels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.errors import InputError
from ventbench.lungs import Lung, lung
from ventbench.plants.frozen import fingerprints
from ventbench.recordings import Breaths, RecordingError, join, load
from ventbench.recordings import folds as assign_folds

_SUFFIXES = (".csv", ".csv.gz", ".parquet")


@dataclass(frozen=True)
class RigRecordings:
    """Recordings of a training.

    Attributes:
        breaths: n breaths, the measured ones first.
        measured: number of breaths without a blank pressure, m. Reconstructed breaths have blanks,
            if only in their expiration.
        fold: fold of each measured breath, ``(m,)``.
        labels: the settings that occur, by R and C.
        sources: SHA-256 and number of breaths of each file, by name.
        skipped: files that are not in the public schema.
    """

    breaths: Breaths
    measured: int
    fold: NDArray[np.int64]
    labels: tuple[Lung, ...]
    sources: dict[str, dict[str, Any]]
    skipped: tuple[str, ...]

    @property
    def measured_breaths(self) -> Breaths:
        """The measured breaths."""
        return self.breaths.select(np.arange(self.measured))


def load_rig_recordings(folder: Path, *, folds: int, seed: int) -> RigRecordings:
    """Read every recording of a folder that is in the public schema.

    A breath that is there twice counts once. Breaths get new ids, in order.

    Args:
        folder: folder with ``.csv``, ``.csv.gz`` and ``.parquet`` files.
        folds: folds of the cross-validation.
        seed: seed of the folds.

    Raises:
        InputError: if a recording is malformed, or there are too few measured breaths.
        OSError: if a file cannot be read.
    """
    parts, sources, skipped = [], {}, []
    for path in sorted(folder.iterdir()):
        if not path.name.lower().endswith(_SUFFIXES):
            continue
        try:
            part = load(path)
        except RecordingError as error:
            if not _other_schema(error):
                raise
            skipped.append(path.name)
            continue
        parts.append(part)
        sources[path.name] = {"sha256": part.sha256, "breaths": len(part)}
    if not parts:
        raise InputError(
            f"{folder} holds no recording in the public schema; put CSV or Parquet files with the "
            "columns id,breath_id,R,C,time_step,u_in,u_out,pressure there"
        )
    breaths = join(parts)
    _, first = np.unique(fingerprints(breaths), return_index=True)
    breaths = breaths.select(np.sort(first))
    blank = breaths.valid & ~np.isfinite(breaths.pressure)
    whole = ~blank.any(axis=1)
    usable = (breaths.inspiratory & np.isfinite(breaths.pressure))[:, 1:].any(axis=1)
    order = np.concatenate([np.flatnonzero(whole & usable), np.flatnonzero(~whole & usable)])
    breaths = breaths.select(order)
    breaths = replace(breaths, breath_id=np.arange(1, len(order) + 1))
    count = int(np.count_nonzero(whole & usable))
    if count < 2 * folds:
        raise InputError(
            f"{folder} holds {count} breaths without a blank pressure; {2 * folds} or more "
            f"are needed, two for each of {folds} folds"
        )
    measured = breaths.select(np.arange(count))
    fold = assign_folds(measured, count=folds, seed=seed)
    labels = tuple(sorted({lung(name) for name in breaths.lung_ids.tolist()}))
    return RigRecordings(breaths, count, fold, labels, sources, tuple(skipped))


def _other_schema(error: RecordingError) -> bool:
    """Whether a file has another header, which is no mistake in a folder of mixed files."""
    return "column" in str(error).lower() and "missing" in str(error).lower()
