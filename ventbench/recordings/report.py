"""The report of a check: what a file holds, counted block by block, and what is wrong with it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ventbench.recordings.roles import breath_figures, few_breaths, findings
from ventbench.recordings.scan import Block, IntervalTable, interval_table
from ventbench.recordings.schema import ProblemLog, RecordingProblem
from ventbench.task.lungs import Lung

PAD_LIMIT = 10
"""Largest factor by which padding may enlarge a file in memory."""


@dataclass(frozen=True)
class RecordingReport:
    """The result of `check`."""

    file: str  #: the path as the caller wrote it.
    #: `csv`, `csv.gz`, `parquet` or `xlsx`, or None if the file cannot be read.
    kind: str | None = None
    sha256: str | None = None  #: SHA-256 of the file, hex, or None if it cannot be read to its end.
    problems: tuple[RecordingProblem, ...] = ()  #: the first problems, in file order.
    problem_count: int = 0  #: number of all problems.
    warnings: tuple[RecordingProblem, ...] = ()  #: the first warnings.
    warning_count: int = 0  #: number of all warnings.
    #: columns that are not what they are called, though `load` takes the file.
    suspicious: tuple[RecordingProblem, ...] = ()
    rows: int = 0  #: data rows read.
    breaths: int = 0  #: breaths read.
    lengths: tuple[int, int] = (0, 0)  #: smallest and largest number of samples in a breath.
    lungs: dict[str, int] = field(default_factory=dict)  #: breaths for each lung, by R then C.
    #: `min` and `max` between two samples and `p5`, `median`, `p95` of the breaths' mean intervals,
    #: s; empty if no times are known.
    interval: dict[str, float] = field(default_factory=dict)
    #: interval, s, inferred for each breath without times, by breath_id.
    time_inferred: dict[int, float] = field(default_factory=dict)
    time_interpolated: int = 0  #: number of single blank times that are interpolated.
    time_shifted: int = 0  #: number of breaths that are shifted to start at time 0.
    blank_pressures: int = 0  #: number of samples without pressure.
    optional: tuple[str, ...] = ()  #: optional columns in the file.

    @property
    def ok(self) -> bool:
        """Whether `load` takes the file."""
        return self.problem_count == 0

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        plain = asdict(self) | {"ok": self.ok}
        plain["time_inferred"] = {str(key): dt for key, dt in self.time_inferred.items()}
        return {k: list(x) if isinstance(x, tuple) else x for k, x in plain.items()}

    def notes(self) -> tuple[str, ...]:
        """What was inferred, changed or ignored, a sentence each."""
        notes = [str(problem) for problem in self.suspicious]
        if self.time_inferred:
            listed = [f"breath {i}: {1e3 * dt:.1f} ms" for i, dt in self.time_inferred.items()]
            more = f" and {len(listed) - 10} more" if len(listed) > 10 else ""
            notes.append(
                f"{len(listed)} breaths have no times; their sampling interval was inferred "
                f"({', '.join(listed[:10])}{more})."
            )
        if self.time_interpolated:
            notes.append(f"{self.time_interpolated} single blank times were interpolated.")
        if self.time_shifted:
            notes.append(f"{self.time_shifted} breaths were shifted to start at time 0.")
        if self.blank_pressures:
            notes.append(f"{self.blank_pressures} of {self.rows} pressures are blank.")
        if self.lengths[0] != self.lengths[1]:
            notes.append("Breaths have {} to {} samples.".format(*self.lengths))
        notes += [str(warning) for warning in self.warnings]
        if self.warning_count > len(self.warnings):
            notes.append(f"... and {self.warning_count - len(self.warnings)} more warnings.")
        few = few_breaths(self.breaths)
        return (*notes, few) if few is not None else tuple(notes)

    def lines(self) -> list[str]:
        """The report as lines of text."""
        lines = []
        if self.breaths:
            lines.append(f"{self.file}: {self.breaths} breaths, {self.rows} rows ({self.kind})")
            lungs = ", ".join(f"{name} {count}" for name, count in self.lungs.items())
            lines.append(f"breaths for each lung: {lungs}")
        if self.interval:
            shown = {name: f"{1e3 * dt:.1f}" for name, dt in self.interval.items()}
            lines.append(
                f"sampling interval: median {shown['median']} ms (5 % to 95 % of breaths: "
                f"{shown['p5']} to {shown['p95']} ms; single steps {shown['min']} to "
                f"{shown['max']} ms)"
            )
        lines += [f"note: {note}" for note in self.notes()[len(self.suspicious) :]]
        lines += [f"suspicious: {problem}" for problem in self.suspicious]
        lines += [f"error: {problem}" for problem in self.problems]
        if self.problem_count > len(self.problems):
            more = self.problem_count - len(self.problems)
            lines.append(f"... and {more} more problems ({self.problem_count} in all).")
        plural = "s" if self.problem_count > 1 else ""
        if not self.ok:
            lines.append(f"not ok: {self.problem_count} problem{plural}")
        else:
            lines.append(f"suspicious: {len(self.suspicious)}" if self.suspicious else "ok")
        return lines


def describe(tally: Tally) -> dict[str, Any]:
    """Return the fields of a report that describe the content of a file."""
    lengths = tally.column("lengths")
    pairs, counts = np.unique(
        np.column_stack([tally.column("R"), tally.column("C")]), axis=0, return_counts=True
    )
    return {
        "rows": int(lengths.sum()),
        "breaths": len(tally),
        "lengths": (int(lengths.min()), int(lengths.max())) if len(tally) else (0, 0),
        "lungs": {Lung(*pair).id: int(n) for pair, n in zip(pairs.tolist(), counts, strict=True)},
        "interval": _intervals(tally),
        "time_inferred": tally.inferred(),
        "time_interpolated": int(tally.column("interpolated").sum()),
        "time_shifted": int(tally.column("shifted").sum()),
        "blank_pressures": tally.blank_pressures,
        "optional": tally.optional,
    }


def role_problems(file: str, tally: Tally) -> dict[str, tuple[RecordingProblem, ...]]:
    """What the physics of a ventilated lung says about the columns, by its level."""
    found = findings(
        tally.figures(), tally.column("interval"), tally.column("R"), tally.column("C")
    )
    return {
        level: tuple(
            RecordingProblem(file, f.what, f.advice, column=f.column, value=f"{f.value:g}")
            for f in found
            if f.level == level
        )
        for level in ("refused", "suspicious")
    }


def _intervals(tally: Tally) -> dict[str, float]:
    means = tally.column("interval")
    means = means[np.isfinite(means)]
    if len(means) == 0 or tally.dt_min > tally.dt_max:
        return {}
    p5, median, p95 = (float(q) for q in np.quantile(means, [0.05, 0.5, 0.95]))
    return {"min": tally.dt_min, "p5": p5, "median": median, "p95": p95, "max": tally.dt_max}


@dataclass
class Tally:
    """Counts over the blocks that were added; keeps a few numbers a breath and no samples."""

    blank_pressures: int = 0  #: samples without pressure.
    dt_min: float = float("inf")  #: shortest known interval between two samples, s.
    dt_max: float = float("-inf")  #: longest known interval, s.
    optional: tuple[str, ...] = ()  #: optional columns in the file.
    _parts: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _figures: list[dict[str, np.ndarray]] = field(default_factory=list)

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
        starts = (np.cumsum(block.lengths) - block.lengths).astype(np.int64)
        with np.errstate(all="ignore"):  # infinite values are problems already
            self._figures.append(breath_figures(block.times.time, block.samples, starts))

    def figures(self) -> dict[str, np.ndarray]:
        """Figures by which roles are checked, (n,) each."""
        return {k: np.concatenate([part[k] for part in self._figures]) for k in self._figures[0]}

    def column(self, name: str) -> np.ndarray:
        """One number a breath, (n,), by the name of a field of `Block` or `KnownTimes`."""
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
        estimates = {
            int(breath): table.estimate(int(n_inspiratory), int(length))
            for breath, n_inspiratory, length in zip(*columns, strict=True)
        }
        return {breath: dt for breath, dt in estimates.items() if dt is not None}


def check_lengths(tally: Tally, log: ProblemLog, *, pad: bool) -> None:
    """Check that all breaths have as many samples as is most common.

    With ``pad`` they may be shorter, unless padding would need far more memory than the file.
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
            log.add(first_row[at], "breath_id", what, advice, values=ids[at])
        return
    usual = int(np.bincount(lengths).argmax())
    for length in np.unique(lengths[lengths != usual]):
        at = np.flatnonzero(lengths == length)
        what = f"breath {{value}} has {length} samples, the others have {usual}"
        advice = "Fix the breath, or pass --pad to fill short ones."
        log.add(first_row[at], "breath_id", what, advice, values=ids[at])


def check_inferable(tally: Tally, log: ProblemLog) -> None:
    """Check that the interval of every breath without times can be inferred."""
    blank = tally.column("blank").astype(bool)
    if not blank.any():
        return
    ids, first_row = tally.column("breath_id"), tally.column("first_row")
    for at in np.flatnonzero(blank & ~np.isin(ids, np.array(list(tally.inferred()), np.int64))):
        what = (
            f"the times of breath {ids[at]} are blank and cannot be inferred: no breath of the "
            "file has times, and u_out does not switch from 0 to 1 in this one"
        )
        advice = "Fill in time_step, in seconds."
        log.add(first_row[at : at + 1], "time_step", what, advice, values=np.array([np.nan]))
