"""Types of arrays that stand everywhere, runs of a mask, batches, and pieces of an array.

Each field and argument says its shape and unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

Columns = dict[str, NDArray[Any]]
"""Arrays by name, of as many samples each if nothing else is said."""

Texts = dict[str, str]
"""Texts by name, such as the roles of columns, their headers and units."""


def runs(mask: Bools) -> list[tuple[int, int]]:
    """Starts and ends of the runs of True in a mask ``(n,)``; a run ends before its end."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def batches(count: int, size: int) -> Iterator[Ints]:
    """Indices of ``count`` things in batches ``(size,)``, so that what runs on one compiles once.

    The last thing is repeated to fill the last batch.
    """
    for first in range(0, count, size):
        yield np.minimum(np.arange(first, first + size), count - 1)


@dataclass(frozen=True, eq=False)
class Pieces:
    """k pieces of m samples that follow one another, such as the breaths of a recording."""

    starts: Ints  #: first sample of each, ``(k,)``.
    total: int  #: samples in all, m.

    @classmethod
    def of(cls, lengths: Sequence[int] | Ints) -> Pieces:
        """Pieces of given lengths, ``(k,)``."""
        ends = np.cumsum(lengths, dtype=np.int64)
        return cls(ends - lengths, int(ends[-1]))

    @cached_property
    def lengths(self) -> Ints:
        """Samples of each, ``(k,)``."""
        return np.diff(self.starts, append=self.total)

    @cached_property
    def owner(self) -> Ints:
        """Number of each sample's piece, from 0, ``(m,)``."""
        return np.repeat(np.arange(len(self.starts)), self.lengths)

    @cached_property
    def within(self) -> Ints:
        """Number of each sample in its piece, from 0, ``(m,)``."""
        return np.arange(self.total) - self.starts[self.owner]

    def sums(self, values: NDArray[Any]) -> NDArray[Any]:
        """Sums of values or counts of flags ``(m,)`` over each piece, ``(k,)``."""
        return np.add.reduceat(values * 1, self.starts)
