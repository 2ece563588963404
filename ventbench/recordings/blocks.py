"""A file as checked blocks of whole breaths: what `load`, `iter_breaths` and `check` share."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from ventbench.recordings.checks import (
    check_ids,
    check_lung,
    check_row_ids,
    check_single,
    check_values,
)
from ventbench.recordings.findings import Findings
from ventbench.recordings.rows import Rows, whole_breaths
from ventbench.recordings.source import Source
from ventbench.recordings.time_checks import check_times
from ventbench.recordings.times import KnownTimes, known_times, leading_zeros


@dataclass(frozen=True)
class Block:
    """k whole breaths with m samples in all.

    Attributes:
        breath_id: (k,) int64.
        R: cmH2O/(L/s), (k,).
        C: mL/cmH2O, (k,).
        first_row: each breath's first data row in the file, from 0, (k,).
        lengths: samples, (k,).
        n_inspiratory: leading samples with u_out = 0, (k,).
        interval: mean sampling interval, s, NaN if times are blank, (k,).
        times: time and what was done to it; s.
        samples: u_in %, u_out 0/1 (int8), pressure cmH2O, and flow mL/s and volume mL if the file
            has them, each (m,).
    """

    breath_id: np.ndarray
    R: np.ndarray
    C: np.ndarray
    first_row: np.ndarray
    lengths: np.ndarray
    n_inspiratory: np.ndarray
    interval: np.ndarray
    times: KnownTimes
    samples: dict[str, np.ndarray]


def scan(
    source: Source, findings: Findings, *, clip: bool = False, batch: int | None = None
) -> Iterator[Block]:
    """Read and check a file.

    Args:
        source: an open file.
        findings: takes all problems and warnings but those of the whole file (unequal lengths).
        clip: bring u_in into 0..100 %.
        batch: breaths in a block, or None for whatever is convenient.

    Yields:
        Blocks in file order, also after problems were found; their values are then not to be used.

    Raises:
        RecordingError: the file cannot be parsed.
    """
    seen: dict[int, int] = {}
    last: int | None = None
    for rows in whole_breaths(source.chunks(), batch):
        check_ids(rows, findings, seen)
        check_single(rows, findings)
        check_lung(rows, findings)
        check_times(rows, findings)
        last = check_row_ids(rows, findings, last)
        columns = check_values(rows, findings, clip=clip)
        with np.errstate(all="ignore"):  # infinite values are problems already
            block = _block(rows, columns)
        yield block


def _block(rows: Rows, columns: dict[str, np.ndarray]) -> Block:
    starts, lengths = rows.starts, rows.lengths
    times = known_times(columns["time_step"], starts, lengths)
    keep = ("u_in", "pressure", "flow", "volume")
    samples = {name: columns[name] for name in keep if name in columns}
    samples["u_out"] = (columns["u_out"] == 1.0).astype(np.int8)
    return Block(
        breath_id=columns["breath_id"][starts],
        R=columns["R"][starts],
        C=columns["C"][starts],
        first_row=rows.row0 + starts,
        lengths=lengths,
        n_inspiratory=leading_zeros(samples["u_out"], starts, lengths),
        interval=times.time[starts + lengths - 1] / np.maximum(lengths - 1, 1),
        times=times,
        samples=samples,
    )


def join(blocks: Sequence[Block]) -> Block:
    """One block of all breaths.

    Args:
        blocks: at least one.

    Returns:
        Their breaths in order.
    """
    if len(blocks) == 1:
        return blocks[0]

    def merged(values: Iterable[np.ndarray]) -> np.ndarray:
        return np.concatenate(list(values))

    times = KnownTimes(
        **{
            field.name: merged(getattr(block.times, field.name) for block in blocks)
            for field in fields(KnownTimes)
        }
    )
    samples = {name: merged(block.samples[name] for block in blocks) for name in blocks[0].samples}
    others = {
        field.name: merged(getattr(block, field.name) for block in blocks)
        for field in fields(Block)
        if field.name not in ("times", "samples")
    }
    return Block(**others, times=times, samples=samples)
