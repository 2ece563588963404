"""The report of a check: what a file holds, and what is wrong with it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ventbench.recordings.roles import breath_figures, few_breaths, findings
from ventbench.recordings.scan import Scanned
from ventbench.recordings.schema import OPTIONAL, ProblemLog, RecordingProblem
from ventbench.task.lungs import Lung

PAD_LIMIT = 10
"""Largest factor by which padding may enlarge a file in memory."""


@dataclass(frozen=True)
class RecordingReport:
    """The result of `check`."""

    file: str  #: the path as the caller wrote it.
    #: `csv`, `csv.gz` or `parquet`, or None if the file cannot be read.
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


def describe(scanned: Scanned) -> dict[str, Any]:
    """Return the fields of a report that describe the content of a file."""
    lengths, times, samples = scanned.lengths, scanned.times, scanned.samples
    pairs, counts = np.unique(np.column_stack([scanned.R, scanned.C]), axis=0, return_counts=True)
    return {
        "rows": int(lengths.sum()),
        "breaths": len(lengths),
        "lengths": (int(lengths.min()), int(lengths.max())),
        "lungs": {Lung(*pair).id: int(n) for pair, n in zip(pairs.tolist(), counts, strict=True)},
        "interval": _intervals(scanned),
        "time_inferred": {
            int(scanned.breath_id[i]): dt for i, dt in scanned.inferred.items() if dt is not None
        },
        "time_interpolated": int(times.interpolated.sum()),
        "time_shifted": int(times.shifted.sum()),
        "blank_pressures": int(np.isnan(samples["pressure"]).sum()),
        "optional": tuple(name for name in OPTIONAL if name in samples),
    }


def role_problems(file: str, scanned: Scanned) -> dict[str, tuple[RecordingProblem, ...]]:
    """What the physics of a ventilated lung says about the columns, by its level."""
    figures = breath_figures(scanned.times.time, scanned.samples, scanned.starts)
    found = findings(figures, scanned.interval, scanned.R, scanned.C)
    return {
        level: tuple(
            RecordingProblem(file, f.what, f.advice, column=f.column, value=f"{f.value:g}")
            for f in found
            if f.level == level
        )
        for level in ("refused", "suspicious")
    }


def _intervals(scanned: Scanned) -> dict[str, float]:
    with np.errstate(invalid="ignore"):  # infinite values are problems already
        steps = np.diff(scanned.times.time)
    steps[scanned.starts[1:] - 1] = np.nan
    steps = steps[np.isfinite(steps)]
    means = scanned.interval[np.isfinite(scanned.interval)]
    if not (len(means) and len(steps)):
        return {}
    p5, median, p95 = (float(q) for q in np.quantile(means, [0.05, 0.5, 0.95]))
    least, most = float(steps.min()), float(steps.max())
    return {"min": least, "p5": p5, "median": median, "p95": p95, "max": most}


def check_lengths(scanned: Scanned, log: ProblemLog, *, pad: bool) -> None:
    """Check that all breaths have as many samples as is most common.

    With ``pad`` they may be shorter, unless padding would need far more memory than the file.
    """
    lengths, ids = scanned.lengths, scanned.breath_id
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
            log.add(scanned.starts[at], "breath_id", what, advice, values=ids[at])
        return
    usual = int(np.bincount(lengths).argmax())
    for length in np.unique(lengths[lengths != usual]):
        at = np.flatnonzero(lengths == length)
        what = f"breath {{value}} has {length} samples, the others have {usual}"
        advice = "Fix the breath, or pass --pad to fill short ones."
        log.add(scanned.starts[at], "breath_id", what, advice, values=ids[at])


def check_inferable(scanned: Scanned, log: ProblemLog) -> None:
    """Check that the interval of every breath without times can be inferred."""
    for at in (i for i, dt in scanned.inferred.items() if dt is None):
        what = (
            f"the times of breath {scanned.breath_id[at]} are blank and cannot be inferred: no "
            "breath of the file has times, and u_out does not switch from 0 to 1 in this one"
        )
        advice, first = "Fill in time_step, in seconds.", scanned.starts[at : at + 1]
        log.add(first, "time_step", what, advice, values=np.array([np.nan]))
