"""A step of a round onto a branch: what was frozen or drawn, or records, as data.

This job may write to the repository, so nothing of a submission is here but numbers and text of
records: checked, replayed through the frozen simulators, and only then signed.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from ci import workflow
from ci.git import AUTHOR, Git
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import attestation, canonical, official_runs, rounds
from ventbench.board.replay import ReplayPlants
from ventbench.board.rounds import Round

TITLE = "Round"

_MAX_FILE_BYTES = 20_000_000


def add(
    scored: Path,
    leaderboard: Path,
    name: str,
    simulators: ReplayPlants,
    secret: str | None = None,
) -> Round:
    """Close a round by what its other jobs left: bounds of one, and of each entry its own job.

    Args:
        scored: what they left, a folder each; of bounds and entries, nothing else is taken.
        leaderboard: to add the records to, each replayed, where the round is drawn.
        name: of the round.
        simulators: the frozen ones.
        secret: key that signs them; without one they have no rank.

    Raises:
        InputError: if there are no bounds, or the key is not one of the leaderboard's.
    """
    own = rounds.load(leaderboard, name)
    if own.state != "drawn":
        raise InputError(f"round {name} is {own.state}; records need it to be drawn")
    files.write_bytes(own.folder / rounds.BOUNDS, _content(scored / "bounds" / rounds.BOUNDS))
    return official_runs.close(leaderboard, name, scored, load=lambda: simulators, secret=secret)


def _content(path: Path) -> bytes:
    if path.is_symlink() or not path.is_file() or path.stat().st_size > _MAX_FILE_BYTES:
        raise InputError(f"{path.name} is no plain file of less than {_MAX_FILE_BYTES} bytes")
    return path.read_bytes()


def commit(checkout: Path, name: str, state: str) -> str:
    """Commit the leaderboard to a new branch.

    Args:
        checkout: of the repository.
        name: of the round.
        state: that it is in now.

    Returns:
        Name of the branch.

    Raises:
        GitError: if the branch exists, or nothing has changed.
    """
    if not re.fullmatch(canonical.ROUND_NAME, name):
        raise InputError(f"{name!r} is no name of a round")
    branch = f"round/{name}-{state}"
    git = Git(checkout)
    git.output("switch", "--quiet", "--create", branch)
    git.output("add", "--all", "--", "leaderboard")
    git.output("commit", "--quiet", "--message", f"Round {name} is {state}", more=AUTHOR)
    return branch


def main() -> int:
    """Propose the state of ``ROUND``, with the records of ``SCORED``; see ``round.yml``."""
    from ventbench.plants import frozen

    checkout, name = Path.cwd(), workflow.required("ROUND")
    lines = []
    if scored := os.environ.get("SCORED"):
        # Read here, where no code of a submission runs.
        secret = os.environ.get(attestation.SECRET) or None
        result = add(Path(scored), checkout / "leaderboard", name, frozen.load(), secret).result
        assert result is not None
        lines += [f"{run}: record {sha256}" for run, sha256 in result.records.items()]
        lines += [f"{run}: {why}" for run, why in result.failed.items()]
        lines.append("signed" if secret else f"not signed, not ranked: {attestation.SECRET} unset")
    state = rounds.load(checkout / "leaderboard", name).state
    branch = commit(checkout, name, state)
    workflow.output(branch=branch)
    workflow.summary(TITLE, [*lines, f"round {name} is {state}: {branch}"])
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
