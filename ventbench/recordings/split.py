"""Splitting recordings into training and held-out breaths, by a seed and the ids of the breaths."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ventbench.base.errors import InputError
from ventbench.base.files import write_text
from ventbench.recordings.breaths import Breaths

FORMAT = "ventbench-split-1"


@dataclass(frozen=True)
class Split:
    """Training and held-out breaths of a recording.

    Attributes:
        train_ids: breath ids for training, increasing.
        held_out_ids: breath ids held out, increasing; none of them is in `train_ids`.
        seed: seed of the split.
        fraction: share that was requested to be held out.
        sha256: SHA-256 of the file of the breaths, hex, or None.
    """

    train_ids: tuple[int, ...]
    held_out_ids: tuple[int, ...]
    seed: int
    fraction: float
    sha256: str | None

    def __post_init__(self) -> None:
        """Refuse an id that occurs twice.

        Raises:
            InputError: if an id is in both parts, or twice in one.
        """
        counts = Counter(self.train_ids + self.held_out_ids)
        twice = [breath for breath, count in counts.items() if count > 1]
        if twice:
            raise InputError(
                f"the split names breaths more than once: {twice[:10]} ({len(twice)} in all); "
                "make a new one, and give each breath an id of its own"
            )

    def apply(self, breaths: Breaths) -> tuple[Breaths, Breaths]:
        """Split breaths.

        Args:
            breaths: breaths of the file that was split, or a selection of them.

        Returns:
            Training and held-out breaths, each in the order of `breaths`.

        Raises:
            InputError: if the breaths are from another file, or the split lacks one of them.
        """
        if self.sha256 and breaths.sha256 and self.sha256 != breaths.sha256:
            raise InputError(
                f"the split was made of a file with SHA-256 {self.sha256[:12]}..., but "
                f"{breaths.source} has {breaths.sha256[:12]}...; make a new split of this file"
            )
        held_out = np.isin(breaths.breath_id, np.array(self.held_out_ids, dtype=np.int64))
        train = np.isin(breaths.breath_id, np.array(self.train_ids, dtype=np.int64))
        unknown = breaths.breath_id[~held_out & ~train]
        if len(unknown):
            raise InputError(
                f"the split does not name breaths {unknown[:10].tolist()} ({len(unknown)} in all); "
                "make a new split of this file"
            )
        return breaths.select(train), breaths.select(held_out)

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {"format": FORMAT, **asdict(self)}

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> Split:
        """Return the split of these JSON values.

        Raises:
            InputError: if they are no split, or an id occurs twice.
        """
        if plain.get("format") != FORMAT:
            raise InputError(f"this is no split: format is {plain.get('format')!r}, not {FORMAT!r}")
        try:
            return cls(
                tuple(int(i) for i in plain["train_ids"]),
                tuple(int(i) for i in plain["held_out_ids"]),
                int(plain["seed"]),
                float(plain["fraction"]),
                plain["sha256"],
            )
        except (KeyError, TypeError) as error:
            raise InputError(f"this split is incomplete: {error}") from error


def split_by_breath(breaths: Breaths, *, held_out: float = 0.2, seed: int = 0) -> Split:
    """Hold out a fraction of the breaths of each lung.

    The breaths of a lung are ordered by the SHA-256 of `{seed}:{breath_id}:{lung}` and the first
    ones are held out: the same on every platform, and no matter how the breaths are ordered. A lung
    of two breaths or more has at least one in each part; the only breath of a lung is for training.

    Args:
        breaths: ids must differ.
        held_out: fraction to hold out, between 0 and 1.
        seed: any whole number.

    Returns:
        The split.

    Raises:
        InputError: if the fraction is not between 0 and 1, or an id occurs twice.
    """
    if not 0.0 < held_out < 1.0:
        raise InputError(f"held_out is {held_out}, but it must lie between 0 and 1")
    train: list[int] = []
    kept_out: list[int] = []
    for lung, index in breaths.by_lung_index.items():
        ids = _shuffled(seed, breaths.breath_id[index].tolist(), lung)
        wanted = math.floor(held_out * len(ids) + 0.5)
        count = 0 if len(ids) < 2 else min(max(wanted, 1), len(ids) - 1)
        kept_out += ids[:count]
        train += ids[count:]
    return Split(tuple(sorted(train)), tuple(sorted(kept_out)), seed, held_out, breaths.sha256)


def folds(breaths: Breaths, *, count: int = 5, seed: int = 0) -> np.ndarray:
    """Assign the breaths of each lung to the folds of a cross-validation, in turn.

    The order is that of :func:`split_by_breath`.

    Args:
        breaths: ids must differ.
        count: number of folds, at least 2.
        seed: any whole number.

    Returns:
        Fold of each breath, 0 to ``count - 1``, int64, shape ``(n,)``.

    Raises:
        InputError: if there are fewer than two folds, or an id occurs twice.
    """
    if count < 2:
        raise InputError(f"a cross-validation needs at least 2 folds, not {count}")
    if len(np.unique(breaths.breath_id)) < len(breaths):
        raise InputError("breath ids are there more than once; give each breath an id of its own")
    fold = np.empty(len(breaths), np.int64)
    for lung, index in breaths.by_lung_index.items():
        place = {int(i): at for at, i in zip(index, breaths.breath_id[index], strict=True)}
        for turn, breath in enumerate(_shuffled(seed, list(place), lung)):
            fold[place[breath]] = turn % count
    return fold


def save_split(split: Split, path: str | os.PathLike[str]) -> None:
    """Write a split as JSON: a temporary file first, then a rename."""
    write_text(Path(path), json.dumps(split.to_dict()) + "\n")


def load_split(path: str | os.PathLike[str]) -> Split:
    """Read a split from JSON.

    Raises:
        InputError: if the file holds no split.
        OSError: if the file cannot be read.
    """
    try:
        return Split.from_dict(json.loads(Path(path).read_text("utf-8")))
    except (ValueError, AttributeError) as error:
        raise InputError(f"{path}: {error}") from error


def _shuffled(seed: int, ids: list[int], lung: str) -> list[int]:
    """Ids in the order of their hashes."""

    def digest(breath_id: int) -> bytes:
        return hashlib.sha256(f"{seed}:{breath_id}:{lung}".encode()).digest()

    return sorted(ids, key=digest)
