"""What a file holds, counted block by block; keeps a few numbers a breath and no samples."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ventbench.recordings.blocks import Block
from ventbench.recordings.findings import Findings
from ventbench.recordings.times import IntervalTable, interval_table

PAD_LIMIT = 10
"""Padding may make a file this many times larger in memory."""


@dataclass
class Tally:
    """Counts over the blocks added so far.

    Attributes:
        blank_pressures: samples without pressure.
        dt_min: shortest known interval between two samples, s.
        dt_max: longest, s.
        optional: optional columns in the file.
    """

    blank_pressures: int = 0
    dt_min: float = float("inf")
    dt_max: float = float("-inf")
    optional: tuple[str, ...] = ()
    _parts: dict[str, list[np.ndarray]] = field(default_factory=dict)

    def add(self, block: Block) -> None:
        """Count a block."""
        for name in ("breath_id", "R", "C", "first_row", "lengths", "n_inspiratory", "interval"):
            self._parts.setdefault(name, []).append(getattr(block, name))
        for name in ("blank", "interpolated", "shifted"):
            self._parts.setdefault(name, []).append(getattr(block.times, name))
        self.blank_pressures += int(np.isnan(block.samples["pressure"]).sum())
        self.optional = tuple(name for name in ("flow", "volume") if name in block.samples)
        with np.errstate(invalid="ignore"):
            steps = np.diff(block.times.time)
        steps[np.cumsum(block.lengths)[:-1] - 1] = np.nan
        steps = steps[np.isfinite(steps)]
        self.dt_min = min(self.dt_min, float(steps.min(initial=np.inf)))
        self.dt_max = max(self.dt_max, float(steps.max(initial=-np.inf)))

    def column(self, name: str) -> np.ndarray:
        """One number a breath, (n,): a field of `Block`, or blank, interpolated, shifted."""
        parts = self._parts.get(name)
        return np.concatenate(parts) if parts else np.zeros(0)

    def __len__(self) -> int:
        """Number of breaths."""
        return sum(len(part) for part in self._parts.get("breath_id", []))

    def table(self) -> IntervalTable:
        """Sampling intervals of the breaths whose times are known."""
        return interval_table(self.column("n_inspiratory"), self.column("interval"))

    def inferred(self) -> dict[int, float]:
        """Interval, s, estimated for each breath without times, by breath_id."""
        table = self.table()
        at = np.flatnonzero(self.column("blank"))
        columns = (self.column(name)[at] for name in ("breath_id", "n_inspiratory", "lengths"))
        found = {int(i): table.estimate(int(n), int(t)) for i, n, t in zip(*columns, strict=True)}
        return {breath: dt for breath, dt in found.items() if dt is not None}


def check_lengths(tally: Tally, findings: Findings, *, pad: bool, expected: int = 0) -> None:
    """Check that all breaths have the same number of samples.

    Args:
        tally: all breaths.
        findings: takes the problems.
        pad: allow shorter breaths, unless padding would need far more memory than the file.
        expected: samples a breath should have; 0 means the most common length.
    """
    lengths, first_row = tally.column("lengths").astype(np.int64), tally.column("first_row")
    if len(lengths) == 0:
        return
    ids = tally.column("breath_id")
    if pad:
        longest = int(lengths.max())
        size = longest * len(lengths)
        if size > max(PAD_LIMIT * int(lengths.sum()), 10_000_000):
            at = np.flatnonzero(lengths == longest)[:1]
            what = (
                f"breath {{value}} has {longest} samples, so padding {len(lengths)} breaths to it "
                f"would make {size} samples of {lengths.sum()}"
            )
            advice = "Put breaths of very different lengths into files of their own."
            findings.add(first_row[at], "breath_id", what, advice, values=ids[at])
        return
    usual = expected or int(np.bincount(lengths).argmax())
    for length in np.unique(lengths[lengths != usual]):
        at = np.flatnonzero(lengths == length)
        what = f"breath {{value}} has {length} samples, the others have {usual}"
        advice = "Fix the breath, or pass --pad to fill short ones."
        findings.add(first_row[at], "breath_id", what, advice, values=ids[at])


def check_inferable(tally: Tally, findings: Findings) -> None:
    """Check that every breath without times can be given some."""
    blank = tally.column("blank").astype(bool)
    if not blank.any():
        return
    inferred = np.array(list(tally.inferred()), dtype=np.int64)
    ids = tally.column("breath_id")
    unknown = blank & ~np.isin(ids, inferred)
    first_row = tally.column("first_row")
    for at in np.flatnonzero(unknown):
        what = (
            f"the times of breath {ids[at]} are blank and cannot be inferred: no breath of the "
            "file has times, and u_out does not switch from 0 to 1 in this one"
        )
        advice = "Fill in time_step, in seconds."
        findings.add(first_row[at : at + 1], "time_step", what, advice, values=np.array([np.nan]))
