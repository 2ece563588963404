"""From what a cell said, or how it ended, to the kind and the words of a failure.

Whatever a cell says was written by the submission: it is cut, escaped and believed in nothing.
"""

from __future__ import annotations

import signal
from typing import NamedTuple

from ventbench.sandbox.child.failures import printable
from ventbench.sandbox.child.wire import Reply
from ventbench.sandbox.pipes import Outcome
from ventbench.sandbox.zygote import signal_name

#: Kinds that a cell may give itself, before the first observation and after it.
_BEFORE, _DURING = ("reset", "import", "construct"), ("act", "type", "value")


class Verdict(NamedTuple):
    """Kind, words and detail of a ``child.failures.Failure``."""

    kind: str
    what: str
    detail: str = ""


def failed(text: bytes, sequence: int) -> Verdict:
    """Verdict on a cell that reported a failure itself.

    Args:
        text: kind, words, detail and the last that it printed, separated by zero bytes.
        sequence: number of the observation that it was answering; 0 before the first.
    """
    kind, what, detail, printed = _fields(text)
    kinds = _DURING if sequence else _BEFORE
    kind = kind if kind in kinds else kinds[0]
    # An import's problems are one on a line, and each is cut and escaped by itself.
    what = "\n".join(printable(line) for line in what.splitlines()[:20])
    return Verdict(kind, what or "the submission ended itself", _with_prints(detail, printed))


def ended(status: int | None) -> Verdict:
    """Verdict on a cell whose pipe has closed without an answer.

    Args:
        status: exit code or minus a signal's number; None if it lives on.
    """
    if status is None:
        return Verdict("wire", "the controller closed its pipe")
    if status >= 0:
        return Verdict("exit", f"the controller ended its process (exit code {status})")
    if -status == signal.SIGXCPU:
        return Verdict("cpu", "the controller used up its processor time (SIGXCPU)")
    return Verdict("crash", f"the controller's process was ended by {signal_name(status)}")


def not_answered(outcome: Outcome, limit_s: float, total: bool) -> Verdict:
    """Verdict on a cell that was out of time.

    Args:
        outcome: what it said when it was asked where it is.
        limit_s: how long was waited.
        total: whether that was the limit of the whole session.
    """
    limit = f"within {limit_s:g} s" + (" for the whole score" if total else "")
    _, _, detail, printed = _fields(outcome.text if isinstance(outcome, Reply) else b"")
    what = f"the controller did not answer {limit}"
    return Verdict("timeout", what, _with_prints(detail, printed))


def _fields(text: bytes) -> list[str]:
    fields = text.decode(errors="replace").split("\0", 3)
    return [*fields, "", "", ""][:4]


def _with_prints(detail: str, printed: str) -> str:
    parts = [printable(detail)] if detail else []
    if printed:
        parts.append(f"it printed {printable(printed[-400:], 400)}")
    return "; ".join(parts)
