"""Which breaths the frozen simulators have been trained on, without keeping the breaths.

A breath is known by its lung and its inspiratory commands: the clock of a copy may have been
estimated otherwise, and a published copy may lack its pressure.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.recordings.breaths import Breaths

#: Fold of a breath that every member has seen, and of one that none has.
BY_ALL, BY_NONE = -1, -2


def fingerprints(breaths: Breaths) -> NDArray[np.uint64]:
    """Short SHA-256 of each breath's lung and inspiratory commands, shape ``(n,)``.

    Commands are rounded to 1e-4 %, so that a copy that was written with fewer digits is known.
    """
    out = np.empty(len(breaths), np.uint64)
    commands = np.round(breaths.u_in * 1e4).astype("<i8")
    for i, (lung, inspiratory) in enumerate(
        zip(breaths.lung_ids, breaths.inspiratory, strict=True)
    ):
        digest = hashlib.sha256(str(lung).encode() + commands[i, inspiratory].tobytes())
        out[i] = int.from_bytes(digest.digest()[:8], "little")
    return out


@dataclass(frozen=True)
class Seen:
    """The breaths of the training.

    Attributes:
        key: fingerprints, increasing, ``(k,)``.
        fold: member that has not seen the breath, or :data:`BY_ALL`, ``(k,)``.
    """

    key: NDArray[np.uint64]
    fold: NDArray[np.int8]

    def folds(self, breaths: Breaths) -> NDArray[np.int64]:
        """Look breaths up: a fold, :data:`BY_ALL` or :data:`BY_NONE`, shape ``(n,)``."""
        wanted = fingerprints(breaths)
        at = np.minimum(np.searchsorted(self.key, wanted), len(self.key) - 1)
        return np.where(self.key[at] == wanted, self.fold[at].astype(np.int64), BY_NONE)


def seen(breaths: Breaths, fold: NDArray[np.int64]) -> Seen:
    """Make the list; of copies of a breath, the one seen by most members decides."""
    key = fingerprints(breaths)
    order = np.lexsort((fold, key))
    first = np.append(True, np.diff(key[order]) > 0)
    kept = order[first]
    repeated = np.isin(key[kept], key[order[~first]])
    return Seen(key[kept], np.where(repeated, BY_ALL, fold[kept]).astype(np.int8))
