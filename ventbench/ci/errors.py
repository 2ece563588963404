"""Why a submission is not taken from its commit, and the names that may be asked for."""

from __future__ import annotations

import re

from ventbench.errors import InputError
from ventbench.submissions.load import printable
from ventbench.submissions.manifest import NAME, NAME_RULE

_COMMIT = re.compile(r"[0-9a-f]{40}")
_MOST_NAMED = 20


class TakeError(InputError):
    """A submission that cannot be taken from its commit.

    Attributes:
        problems: one sentence for each.
    """

    def __init__(self, *problems: str):
        named = [printable(problem, 500) for problem in problems[:_MOST_NAMED]]
        if len(problems) > _MOST_NAMED:
            named.append(f"and {len(problems) - _MOST_NAMED} more problems")
        self.problems = tuple(named)
        super().__init__("\n".join(named))


def commit_name(text: str, what: str = "commit") -> str:
    """Return the full name of a commit as it was given, if it is one.

    Raises:
        TakeError: if it is not: a branch, a tag or a shortened name may move.
    """
    if not _COMMIT.fullmatch(text):
        raise TakeError(
            f"{what} {text!r} is not 40 lower-case hexadecimal digits; "
            "copy the full name of the commit that was reviewed"
        )
    return text


def submission_name(text: str) -> str:
    """Return the name of a submission as it was given, if it may be one.

    Raises:
        TakeError: if it may not.
    """
    if not NAME.fullmatch(text):
        raise TakeError(f"name {text!r} {NAME_RULE}")
    return text
