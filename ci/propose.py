"""Records, as data, into the leaderboard of a checkout, and from there onto a branch.

This job may write to the repository, so nothing of a submission is here but numbers and text of a
record: checked, and replayed through the frozen simulators.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from ci import workflow
from ci.git import AUTHOR, Git
from ci.take import submission_name
from ventbench.base.errors import InputError
from ventbench.board import attestation, create, record, store
from ventbench.board.record import Record
from ventbench.board.replay import ReplayPlants

TITLE = "Record"

#: Why a new record of an entry supersedes the old one, for the page.
SCORED_AGAIN = "the entry was scored again"

#: Most records of one run: one a track.
MAX_RECORDS = 2
_MAX_FILE_BYTES = 20_000_000
_RECORD = re.compile(rf"[0-9a-f]{{64}}{re.escape(record.SUFFIX)}")


def records(folder: Path) -> list[Path]:
    """Records among downloaded files.

    Args:
        folder: of the download.

    Raises:
        InputError: if there is none, or anything unexpected.
    """
    for path in folder.rglob("*"):
        if path.is_symlink() or not path.is_file() or path.stat().st_size > _MAX_FILE_BYTES:
            raise InputError(f"{path.name} is no plain file of less than {_MAX_FILE_BYTES} bytes")
    paths = sorted(path for path in folder.iterdir() if _RECORD.fullmatch(path.name))
    if not 1 <= len(paths) <= MAX_RECORDS:
        raise InputError(f"{folder} holds {len(paths)} records; 1 to {MAX_RECORDS} are expected")
    return paths


def add(
    folder: Path,
    leaderboard: Path,
    simulators: ReplayPlants,
    secret: str | None = None,
) -> list[Record]:
    """Add records to a leaderboard, each replayed.

    The record of an entry that has one already names the old one as superseded.

    Args:
        folder: of the download.
        leaderboard: to add them to.
        simulators: the frozen ones.
        secret: key that signs them; without one they are listed as not official.

    Raises:
        InputError: if a record is not what it must be, or the key is not one of the leaderboard's.
    """
    added: list[Record] = []
    for path in records(folder):
        scored = record.load(path)
        if not isinstance(scored, Record):
            raise InputError(f"{path} is not the record of a score")
        older = store.newest_of(store.load(leaderboard), scored)
        if older is not None and older.sha256 != scored.sha256:
            path = create.amend(path, supersedes=older.sha256, reason=SCORED_AGAIN)
        new = store.add(leaderboard, path, simulators)
        assert isinstance(new, Record)
        if secret:
            attestation.sign(leaderboard, new.sha256, secret)
        added.append(new)
    return added


def commit(checkout: Path, added: Sequence[Record]) -> str:
    """Commit the leaderboard to a new branch.

    Args:
        checkout: of the repository.
        added: records.

    Returns:
        Name of the branch.

    Raises:
        GitError: if the branch exists, or nothing has changed.
    """
    branch = f"record/{submission_name(added[0].name)}-{added[0].sha256[:12]}"
    git = Git(checkout)
    git.output("switch", "--quiet", "--create", branch)
    git.output("add", "--all", "--", "leaderboard")
    what = f"Record {added[0].name}: {', '.join(sorted(score.track for score in added))}"
    git.output("commit", "--quiet", "--message", what, more=AUTHOR)
    return branch


def main() -> int:
    """Add what was downloaded to ``RECORDS``; see ``score-official.yml``."""
    from ventbench.plants import frozen

    checkout = Path.cwd()
    # Read here, where no code of a submission runs.
    secret = os.environ.get(attestation.SECRET) or None
    downloaded = Path(workflow.required("RECORDS"))
    added = add(downloaded, checkout / "leaderboard", frozen.load(), secret)
    branch = commit(checkout, added)
    workflow.output(branch=branch, name=added[0].name)
    workflow.summary(
        TITLE,
        [
            *(f"{score.name} ({score.track}): record {score.sha256}" for score in added),
            "signed" if secret else f"not signed, so not official: {attestation.SECRET} is not set",
        ],
    )
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
