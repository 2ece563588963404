"""Rows as flat arrays: pieces of a file, cut where a breath ends."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Chunk:
    """Some consecutive rows of a file, as read.

    Attributes:
        row0: the first row's number in the file, 0 for the first data row.
        columns: arrays by column name, each (m,): int64 for id and breath_id, float64 with NaN for
            blank otherwise, in the units of the schema.
        blank_id: where breath_id is blank, (m,) bool; breath_id then repeats the one before.
    """

    row0: int
    columns: dict[str, np.ndarray]
    blank_id: np.ndarray

    def __len__(self) -> int:
        """Number of rows m."""
        return len(self.blank_id)

    def cut(self, start: int, stop: int) -> Chunk:
        """Rows start..stop-1, as views."""
        columns = {name: values[start:stop] for name, values in self.columns.items()}
        return Chunk(self.row0 + start, columns, self.blank_id[start:stop])


@dataclass(frozen=True)
class Rows(Chunk):
    """Rows of whole breaths.

    Attributes:
        starts: index of each breath's first row, (k,), k >= 1.
    """

    starts: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Rows in each breath, (k,)."""
        return np.diff(self.starts, append=len(self))


def whole_breaths(chunks: Iterable[Chunk], batch: int | None = None) -> Iterator[Rows]:
    """Regroup pieces of a file so that none ends inside a breath.

    Args:
        chunks: the file in order.
        batch: breaths in each group (the last may have fewer), or None for whatever is convenient.

    Yields:
        Rows of whole breaths, in order.
    """
    held: list[Chunk] = []
    held_breaths = 0
    for chunk in chunks:
        if held and held[-1].columns["breath_id"][-1] == chunk.columns["breath_id"][0]:
            held_breaths -= 1
        held.append(chunk)
        held_breaths += len(_starts(chunk))
        if held_breaths > (batch or 1):
            rows = _join(held)
            stops = _stops(rows, batch)
            yield from _cut(rows, stops)
            rest = rows.cut(int(stops[-1]), len(rows))
            held, held_breaths = [rest], len(_starts(rest))
    if held:
        rows = _join(held)
        stops = _stops(rows, batch) if batch else np.zeros(0, dtype=np.int64)
        yield from _cut(rows, np.append(stops, len(rows)))


def _starts(chunk: Chunk) -> np.ndarray:
    ids = chunk.columns["breath_id"]
    return np.append(0, np.flatnonzero(ids[1:] != ids[:-1]) + 1)


def _stops(rows: Chunk, batch: int | None) -> np.ndarray:
    """Where groups end for certain: the last breath may go on in the next chunk."""
    starts = _starts(rows)
    return starts[-1:] if batch is None else starts[batch::batch]


def _cut(rows: Chunk, stops: np.ndarray) -> Iterator[Rows]:
    start = 0
    for stop in stops:
        if stop > start:
            part = rows.cut(start, int(stop))
            yield Rows(part.row0, part.columns, part.blank_id, _starts(part))
        start = int(stop)


def _join(chunks: list[Chunk]) -> Chunk:
    if len(chunks) == 1:
        return chunks[0]
    columns = {
        name: np.concatenate([chunk.columns[name] for chunk in chunks])
        for name in chunks[0].columns
    }
    blank = np.concatenate([chunk.blank_id for chunk in chunks])
    return Chunk(chunks[0].row0, columns, blank)
