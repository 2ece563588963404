"""What is wrong with a submission, in words for its author: failures, findings and reports."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from ventbench.sandbox.child.cell import Failure as Failure
from ventbench.sandbox.child.cell import SubmissionError as SubmissionError
from ventbench.sandbox.child.cell import printable as printable

#: What is looked at, in this order.
Group = Literal["files", "manifest", "source", "run", "repeat", "time"]
GROUPS: tuple[Group, ...] = ("files", "manifest", "source", "run", "repeat", "time")


@dataclass(frozen=True)
class Finding:
    """One problem or note."""

    group: Group  #: what was looked at, one of :data:`GROUPS`.
    file: str  #: path below the folder, or words such as ``"the folder"``; printable.
    what: str  #: is wrong with it; printable.
    advice: str  #: what to do; printable.
    line: int | None = None  #: counted from 1; None where there is none.
    column: int | None = None  #: counted from 1; None where there is none.
    problem: bool = True  #: whether it stops the submission.

    def __post_init__(self) -> None:
        # File names, values and exceptions are the author's; a terminal and a page show this.
        for name in ("file", "what", "advice"):
            object.__setattr__(self, name, printable(getattr(self, name), 500))

    @property
    def where(self) -> str:
        """File, line and column, such as ``"controller.py line 3, column 8"``."""
        line = "" if self.line is None else f" line {self.line}"
        return self.file + line + ("" if self.column is None else f", column {self.column}")

    def message(self, label: str) -> str:
        """Two lines for a person."""
        kind = "" if self.problem else "note: "
        return f"{label}: {kind}{self.where}: {self.what}\n    {self.advice}"

    def to_json(self) -> dict[str, Any]:
        """Return the finding as JSON values."""
        names = ("group", "file", "line", "column", "what", "advice")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class CheckReport:
    """All findings of a submission."""

    label: str  #: the submission, as the person named it.
    findings: tuple[Finding, ...]  #: all of them, in the order of :data:`GROUPS`.
    left_out: tuple[Group, ...] = ()  #: groups that could not be looked at because of the problems.
    #: layers that the dry run had; None if it ran in this process, or did not run.
    sandbox: dict[str, Any] | None = None
    #: mean and largest time of an ``act``, microseconds; None if it did not run.
    act_us: tuple[float, float] | None = None

    @property
    def problems(self) -> tuple[Finding, ...]:
        """Findings that stop the submission."""
        return tuple(finding for finding in self.findings if finding.problem)

    @property
    def notes(self) -> tuple[Finding, ...]:
        """The other findings."""
        return tuple(finding for finding in self.findings if not finding.problem)

    @property
    def ok(self) -> bool:
        """Whether it can be submitted."""
        return not self.problems

    def lines(self) -> Iterable[str]:
        """The report for a person: problems, then notes, then the verdict."""
        label = printable(self.label)
        for finding in (*self.problems, *self.notes):
            yield from finding.message(label).split("\n")
        if self.left_out:
            yield f"{label}: not looked at yet: {', '.join(self.left_out)}; mend the above first"
        if self.act_us is not None:
            mean, largest = self.act_us
            yield f"{label}: act takes {mean:.0f} us on average, {largest:.0f} us at most"
        count = len(self.problems)
        if count:
            yield f"{label}: {count} {'problem' if count == 1 else 'problems'}; not ready to submit"
        else:
            yield f"{label}: no problems; ready to submit"

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        timing = {"mean": self.act_us[0], "max": self.act_us[1]} if self.act_us else None
        return {
            "submission": self.label,
            "ok": self.ok,
            "problems": [finding.to_json() for finding in self.problems],
            "notes": [finding.to_json() for finding in self.notes],
            "left_out": list(self.left_out),
            "sandbox": self.sandbox,
            "act_us": timing,
        }
