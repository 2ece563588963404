"""What a check of a recording found, for people and for machines."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ventbench.lungs import Lung
from ventbench.recordings.errors import Problem
from ventbench.recordings.tally import Tally

SLOW = 0.5
"""A median sampling interval above this, s, suggests another unit."""


@dataclass(frozen=True)
class CheckReport:
    """The result of `check`.

    Attributes:
        file: the path as the caller wrote it.
        kind: `csv`, `csv.gz` or `parquet`, or None if that could not be told.
        sha256: of the file, hex, or None if it could not be read to its end.
        problems: the first problems, in file order.
        problem_count: how many problems there are in all.
        warnings: the first warnings.
        warning_count: how many warnings there are in all.
        rows: data rows read.
        breaths: breaths read.
        lengths: smallest and largest number of samples in a breath.
        lungs: breaths for each lung, by R then C.
        interval: s: `min` and `max` between two samples, `p5`, `median`, `p95` of the breaths' mean
            intervals; empty if no times are known.
        time_inferred: interval, s, inferred for each breath without times, by breath_id.
        time_interpolated: single blank times that were filled in.
        time_shifted: breaths that do not start at time 0 and were moved there.
        blank_pressures: samples without pressure.
        optional: optional columns in the file.
    """

    file: str
    kind: str | None = None
    sha256: str | None = None
    problems: tuple[Problem, ...] = ()
    problem_count: int = 0
    warnings: tuple[Problem, ...] = ()
    warning_count: int = 0
    rows: int = 0
    breaths: int = 0
    lengths: tuple[int, int] = (0, 0)
    lungs: dict[str, int] = field(default_factory=dict)
    interval: dict[str, float] = field(default_factory=dict)
    time_inferred: dict[int, float] = field(default_factory=dict)
    time_interpolated: int = 0
    time_shifted: int = 0
    blank_pressures: int = 0
    optional: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether `load` takes the file."""
        return self.problem_count == 0

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        plain = {name: getattr(self, name) for name in self.__dataclass_fields__}
        plain["ok"] = self.ok
        plain["problems"] = [problem.to_dict() for problem in self.problems]
        plain["warnings"] = [problem.to_dict() for problem in self.warnings]
        plain["lengths"] = list(self.lengths)
        plain["optional"] = list(self.optional)
        plain["time_inferred"] = {str(key): dt for key, dt in self.time_inferred.items()}
        return plain

    def notes(self) -> tuple[str, ...]:
        """What was filled in, changed or ignored, a sentence each."""
        notes = []
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
        return tuple(notes)

    def lines(self) -> list[str]:
        """The report for a person."""
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
        lines += [f"note: {note}" for note in self.notes()]
        lines += [f"error: {problem}" for problem in self.problems]
        if self.problem_count > len(self.problems):
            more = self.problem_count - len(self.problems)
            lines.append(f"... and {more} more problems ({self.problem_count} in all).")
        lines.append("ok" if self.ok else f"not ok: {self.problem_count} problems")
        return lines


def describe(tally: Tally) -> dict[str, Any]:
    """The fields of a report that count what the file holds.

    Args:
        tally: all breaths.

    Returns:
        Keyword arguments for `CheckReport`.
    """
    lengths = tally.column("lengths")
    pairs, counts = np.unique(
        np.column_stack([tally.column("R"), tally.column("C")]), axis=0, return_counts=True
    )
    return {
        "rows": int(lengths.sum()),
        "breaths": len(tally),
        "lengths": (int(lengths.min(initial=1 << 62)), int(lengths.max()))
        if len(tally)
        else (0, 0),
        "lungs": {Lung(*pair).id: int(n) for pair, n in zip(pairs.tolist(), counts, strict=True)},
        "interval": _intervals(tally),
        "time_inferred": tally.inferred(),
        "time_interpolated": int(tally.column("interpolated").sum()),
        "time_shifted": int(tally.column("shifted").sum()),
        "blank_pressures": tally.blank_pressures,
        "optional": tally.optional,
    }


def unit_warning(file: str, tally: Tally) -> tuple[Problem, ...]:
    """A warning if times look like milliseconds."""
    median = tally.table().overall
    if median is None or median <= SLOW:
        return ()
    what = f"the median sampling interval is {median:g} s"
    advice = "time_step is in seconds; divide by 1000 if the file has milliseconds."
    return (Problem(file, what, advice, column="time_step", value=f"{median:g}"),)


def _intervals(tally: Tally) -> dict[str, float]:
    means = tally.column("interval")
    means = means[np.isfinite(means)]
    if len(means) == 0 or tally.dt_min > tally.dt_max:
        return {}
    p5, median, p95 = (float(q) for q in np.quantile(means, [0.05, 0.5, 0.95]))
    return {"min": tally.dt_min, "p5": p5, "median": median, "p95": p95, "max": tally.dt_max}
