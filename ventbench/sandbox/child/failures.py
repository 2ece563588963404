"""How a controller fails, in words for its author; standard library only."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from ventbench.base.errors import InputError


def printable(text: str, length: int = 300) -> str:
    """One line that no terminal or page misreads: other characters escaped, cut to a length."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return text if len(text) <= length else text[: length - 3] + "..."


class SubmissionError(InputError):
    """A submission that cannot be run at all.

    Attributes:
        problems: one sentence for each, with file and key or line.
    """

    def __init__(self, *problems: str):
        self.problems = problems
        super().__init__("\n".join(problems))


@dataclass(frozen=True)
class Failure:
    """One controller that failed during a run; its entry is listed, not ranked.

    Attributes:
        kind: ``"construct"``, ``"reset"``, ``"act"`` (it raised there), ``"type"`` (no number),
            ``"value"`` (NaN or infinite); a sandbox adds its own, such as ``"timeout"``.
        what: what happened, such as ``"controller.py line 7 raised ValueError"``.
        detail: the exception's text, or empty.
        breath: counted from 1; None before the first step.
        step: of the breath, counted from 1; None before the first step.
    """

    kind: str
    what: str
    detail: str = ""
    breath: int | None = None
    step: int | None = None

    def message(self, submission: str, lung: str | None) -> str:
        """One sentence for a person.

        Args:
            submission: its folder, as the person wrote it.
            lung: id of the lung if the submission knew it.
        """
        when = "" if self.step is None else f" at step {self.step} of breath {self.breath}"
        detail = f": {self.detail}" if self.detail else ""
        where = f"(lung {lung or 'hidden'})"
        return f"{submission}: {self.what}{when} {where}{detail}; the entry is not ranked."

    def to_json(self) -> dict[str, Any]:
        """Return the attributes as JSON values."""
        return dataclasses.asdict(self)
