"""The leaderboard as a branch of its own: exactly what is committed, as pages."""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

from ci import workflow
from ci.git import AUTHOR, Git, GitError
from ventbench.errors import InputError

TITLE = "Pages"
LEADERBOARD = "leaderboard"

_PLAIN = "100644"


def pages(git: Git, commit: str, previous: str | None = None) -> str | None:
    """Make a commit whose root is the leaderboard of another commit.

    Args:
        git: repository.
        commit: whose ``leaderboard/`` is published.
        previous: commit of the pages until now; None if there is none.

    Returns:
        The new commit; None if nothing has changed.

    Raises:
        InputError: if there is no leaderboard, or anything but plain files in it.
    """
    tree = f"{commit}:{LEADERBOARD}"
    try:
        listing = git.output("ls-tree", "-r", "-z", tree, limit=50_000_000)
    except GitError as error:
        raise InputError(f"commit {commit} holds no {LEADERBOARD}/: {error}") from None
    lines = [line.decode() for line in listing.split(b"\0") if line]
    odd = [line.partition("\t")[2] for line in lines if not line.startswith(f"{_PLAIN} blob ")]
    if odd:
        raise InputError(f"{LEADERBOARD}/{odd[0]} is no plain file")
    if not any(line.endswith("\tindex.html") for line in lines):
        raise InputError(f"{LEADERBOARD}/index.html is missing; run ventbench board build")
    with tempfile.TemporaryDirectory() as folder:
        index = {"GIT_INDEX_FILE": str(Path(folder) / "index")}
        git.output("read-tree", tree, more=index)
        empty = git.output("hash-object", "-w", "--stdin").decode().strip()
        # Else the server leaves out what begins with an underscore.
        added = f"{_PLAIN} {empty}\t.nojekyll\n".encode()
        git.output("update-index", "--add", "--index-info", given=added, more=index)
        root = git.text("write-tree", more=index)
    if previous and git.text("rev-parse", f"{previous}^{{tree}}") == root:
        return None
    parents = ["-p", previous] if previous else []
    return git.text("commit-tree", root, *parents, "-m", f"Pages of {commit}", more=AUTHOR)


def main() -> int:
    """Make the pages of ``COMMIT`` in this checkout; see ``publish.yml``."""
    git = Git(Path.cwd())
    previous = git.text("for-each-ref", "--format=%(objectname)", "refs/remotes/origin/gh-pages")
    commit = workflow.required("COMMIT")
    if not re.fullmatch(r"[0-9a-f]{40}", commit):
        raise InputError(f"COMMIT is {commit!r}, not the full name of one")
    made = pages(git, commit, previous or None)
    workflow.output(commit=made or "")
    workflow.summary(TITLE, [f"pages {made}" if made else "the pages are up to date"])
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
