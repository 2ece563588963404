"""The leaderboard as a branch of its own: records, chain and built pages, and no other file.

What was published before stays: a chain that does not begin with the published one is refused.
"""

from __future__ import annotations

import hashlib
import re
import sys
import tempfile
from pathlib import Path

from ci import workflow
from ci.git import AUTHOR, Git, GitError
from ventbench.board import layout
from ventbench.errors import InputError

TITLE = "Pages"
LEADERBOARD = "leaderboard"

_PLAIN = "100644"
_MAX_CHAIN_BYTES = 100_000_000


def pages(git: Git, commit: str, previous: str | None = None) -> str | None:
    """Make a commit whose root is the leaderboard of another commit.

    Args:
        git: repository.
        commit: whose ``leaderboard/`` is published.
        previous: commit of the pages until now; None if there is none.

    Returns:
        The new commit; None if nothing has changed.

    Raises:
        InputError: if there is no leaderboard, anything but its own plain files in it, or a chain
            that does not begin with the one published until now, or a published season that was
            changed.
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
    names = {line.partition("\t")[2] for line in lines}
    for required in (layout.INDEX, layout.CHAIN):
        if required not in names:
            raise InputError(f"{LEADERBOARD}/{required} is missing; run ventbench board build")
    chain = chain_of(git, f"{tree}/{layout.CHAIN}")
    stray = layout.stray(names, chain)
    if stray:
        raise InputError(f"{LEADERBOARD}/{stray[0]} is no part of a leaderboard; remove it")
    if previous and not chain.startswith(published(git, previous)):
        raise InputError(
            f"{LEADERBOARD}/{layout.CHAIN} does not begin with the published chain: records were "
            "dropped, changed or put into another order"
        )
    if previous:
        _require_seasons(git, tree, names, previous)
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


def chain_of(git: Git, name: str) -> bytes:
    """Content of a chain, by git's name of the file.

    Raises:
        GitError: if there is none.
    """
    return git.output("cat-file", "blob", name, limit=_MAX_CHAIN_BYTES)


def published(git: Git, previous: str) -> bytes:
    """The chain among pages; empty where the branch was made before there were records.

    Args:
        git: repository.
        previous: commit of the pages.
    """
    if not git.output("ls-tree", "-z", previous, "--", layout.CHAIN):
        return b""
    return chain_of(git, f"{previous}:{layout.CHAIN}")


def _require_seasons(git: Git, tree: str, names: set[str], previous: str) -> None:
    """Refuse a season that was published and is gone, or says something else than then.

    Else whoever holds several seeds could choose among their commitments afterwards.
    """
    listing = git.output("ls-tree", "-r", "--name-only", "-z", previous, limit=50_000_000)
    for name in sorted(filter(layout.is_season, listing.decode().split("\0"))):
        before = git.output("cat-file", "blob", f"{previous}:{name}")
        if name not in names:
            raise InputError(f"{LEADERBOARD}/{name} was published and is missing")
        if not layout.same_season(before, git.output("cat-file", "blob", f"{tree}/{name}")):
            raise InputError(
                f"{LEADERBOARD}/{name} is not the one that was published; only its seed may join it"
            )


def head(git: Git, previous: str | None) -> str:
    """Head of the published chain, for ``ventbench board verify --head``.

    Args:
        git: repository.
        previous: commit of the pages; None if there is none.

    Returns:
        SHA-256 of the last line; zeros, the start of every chain, if nothing is published.
    """
    lines = published(git, previous).splitlines(keepends=True) if previous else []
    return hashlib.sha256(lines[-1]).hexdigest() if lines else "0" * 64


def main() -> int:
    """Make the pages of ``COMMIT`` in this checkout, or say the head; see ``publish.yml``."""
    git = Git(Path.cwd())
    previous = git.text("for-each-ref", "--format=%(objectname)", "refs/remotes/origin/gh-pages")
    if sys.argv[1:] == ["head"]:
        workflow.output(head=head(git, previous or None))
        return 0
    commit = workflow.required("COMMIT")
    if not re.fullmatch(r"[0-9a-f]{40}", commit):
        raise InputError(f"COMMIT is {commit!r}, not the full name of one")
    made = pages(git, commit, previous or None)
    workflow.output(commit=made or "")
    workflow.summary(TITLE, [f"pages {made}" if made else "the pages are up to date"])
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
