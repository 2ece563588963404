"""Records come alone: no change adds one together with what decides whether it counts.

Keys, second runs, bench logs, the files that fix a round before it is scored, and the code that
judges records must have been reviewed before; else whoever proposes a record could vouch for it in
the same breath.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

from ci import workflow
from ci.git import Git
from ventbench.board import canonical

TITLE = "Records apart from what vouches for them"
LEADERBOARD = "leaderboard"

#: Where the code that judges lies: the beacon's key, the gate, metrics, sandbox and plants, their
#: data, the packages that compute them, and the workflows.
JUDGES = (
    ".github/",
    "ci/",
    "ventbench/",
    "data/",
    "requirements.lock",
    "pyproject.toml",
    "Makefile",
)

#: Files of a round that are written with its records.
_WITH_RECORDS = {*canonical.ROUND_FILES[-2:], canonical.SEEDS, "result.sig"}


def problems(paths: Iterable[str]) -> list[str]:
    """Say what a change may not hold together.

    Args:
        paths: that it adds, changes or removes, from the root of the repository.
    """
    paths = list(paths)
    inside = [Path(x).relative_to(LEADERBOARD) for x in paths if x.startswith(f"{LEADERBOARD}/")]
    records = [path for path in inside if path.parts[0] == canonical.RECORDS]
    deciding = [path for path in paths if path.startswith(JUDGES)]
    deciding += [
        f"{LEADERBOARD}/{path}"
        for path in inside
        if path.name == canonical.ATTESTATIONS
        or (path.parts[0] == canonical.ROUNDS and path.name not in _WITH_RECORDS)
    ]
    if not records or not deciding:
        return []
    return [
        f"{path} changes together with {len(records)} files of records: propose it by itself first"
        for path in sorted(deciding)
    ]


def main() -> int:
    """Check what lies between ``BASE`` and ``COMMIT``, both in this checkout."""
    git = Git(Path.cwd())
    base, commit = workflow.required("BASE"), workflow.required("COMMIT")
    fork = git.text("merge-base", base, commit)
    listed = git.output("diff-tree", "-r", "-z", "--no-renames", "--name-only", fork, commit)
    found = problems(x for x in listed.decode(errors="replace").split("\0") if x)
    workflow.summary(TITLE, found or ["nothing comes together that must come apart"])
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
