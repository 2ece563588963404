"""A step of a round onto a branch: what was frozen or drawn, or records, as data.

This job may write to the repository, so nothing of a submission is here but numbers and text of
records: checked, replayed through the frozen simulators, and only then signed.
"""

from __future__ import annotations

import os
import re
import sys
from functools import partial
from pathlib import Path

from ci import workflow
from ci.git import AUTHOR, Git
from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.board import canonical, gate, record, rounds, store
from ventbench.board.record import Record
from ventbench.board.replay import ReplayPlants, require_replay

TITLE = "Round"

_MAX_FILE_BYTES = 20_000_000


def add(
    scored: Path,
    leaderboard: Path,
    name: str,
    simulators: ReplayPlants,
    secret: str | None = None,
) -> list[Record]:
    """Add the records of a scored round to a leaderboard, each replayed.

    Args:
        scored: the leaderboard that the other job had at its end; only bounds, result and what the
            result names are taken from it.
        leaderboard: to add them to, where the round is drawn.
        name: of the round.
        simulators: the frozen ones.
        secret: key that signs them; without one they have no rank.

    Raises:
        InputError: if a record is not what it must be, or the key is not one of the leaderboard's.
    """
    own = rounds.load(leaderboard, name)
    if own.state != "drawn":
        raise InputError(f"round {name} is {own.state}; records need it to be drawn")
    contents = {
        file: _content(scored / canonical.ROUNDS / name / file)
        for file in (rounds.BOUNDS, rounds.RESULT)
    }
    for file, content in contents.items():
        files.write_atomically(own.folder / file, lambda f, content=content: f.write(content))
    result = rounds.load(leaderboard, name).result
    assert result is not None
    added: list[Record] = []
    for sha256 in result.records.values():
        path = scored / canonical.RECORDS / f"{sha256}{record.SUFFIX}"
        _content(path)
        new = store.add(leaderboard, path, partial(require_replay, simulators))
        if not isinstance(new, Record) or new.header.draws.sha256 != own.commitment:
            raise InputError(f"{path.name} is no record of round {name}")
        if secret:
            gate.sign(leaderboard, store.path_of(leaderboard, new.sha256), secret)
        added.append(new)
    if secret:
        gate.sign(leaderboard, own.folder / rounds.RESULT, secret)
    return added


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
        secret = os.environ.get(gate.SECRET) or None
        added = add(Path(scored), checkout / "leaderboard", name, frozen.load(), secret)
        lines += [f"{score.name} ({score.track}): record {score.sha256}" for score in added]
        lines.append("signed" if secret else f"not signed, not ranked: {gate.SECRET} unset")
    state = rounds.load(checkout / "leaderboard", name).state
    branch = commit(checkout, name, state)
    workflow.output(branch=branch)
    workflow.summary(TITLE, [*lines, f"round {name} is {state}: {branch}"])
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
