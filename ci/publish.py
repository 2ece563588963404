"""The leaderboard as a branch of its own: its records, its built pages, and no other file.

What was published before stays: a commit that lacks a published record, or changes one, is refused.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

from ci import workflow
from ci.git import AUTHOR, Git, GitError
from ventbench.base.errors import InputError
from ventbench.board import canonical

TITLE = "Pages"
LEADERBOARD = "leaderboard"

_PLAIN = "100644"
#: Most bytes of the listing of a tree.
_MAX_LISTING = 50_000_000


def pages(git: Git, commit: str, site: Path, previous: str | None = None) -> str | None:
    """Make a commit whose root is the leaderboard of another commit and its pages.

    Args:
        git: repository.
        commit: whose ``leaderboard/`` is published.
        site: folder that ``ventbench board build`` made of it; its records are not looked at.
        previous: commit of the pages until now; None if there is none.

    Returns:
        The new commit; None if nothing has changed.

    Raises:
        InputError: if there is no leaderboard, anything but its own plain files in it or in the
            site, or a published record that is missing or was changed.
    """
    tree = f"{commit}:{LEADERBOARD}"
    try:
        listed = _files(git, tree)
    except GitError as error:
        raise InputError(f"commit {commit} holds no {LEADERBOARD}/: {error}") from None
    for name, (mode, _) in listed.items():
        if mode != _PLAIN:
            raise InputError(f"{LEADERBOARD}/{name} is no plain file")
        if not canonical.named(name):
            raise InputError(f"{LEADERBOARD}/{name} is no part of a leaderboard; remove it")
    plain, odd = canonical.walk(site)
    built = sorted(filter(canonical.BUILT.fullmatch, plain))
    stray = [*odd, *sorted(x for x in plain - set(built) if not canonical.named(x))]
    if stray:
        raise InputError(f"{site / stray[0]} is no page of a leaderboard; remove it")
    if canonical.INDEX not in built:
        raise InputError(f"{site / canonical.INDEX} is missing; run ventbench board build")
    if previous:
        _require_published(listed, _files(git, previous))
    with tempfile.TemporaryDirectory() as folder:
        index = {"GIT_INDEX_FILE": str(Path(folder) / "index")}
        git.output("read-tree", tree, more=index)
        # Else the server leaves out what begins with an underscore.
        contents = {name: (site / name).read_bytes() for name in built} | {".nojekyll": b""}
        for name, content in contents.items():
            blob = git.output("hash-object", "-w", "--stdin", given=content).decode().strip()
            line = f"{_PLAIN} {blob}\t{name}\n".encode()
            git.output("update-index", "--add", "--index-info", given=line, more=index)
        root = git.text("write-tree", more=index)
    if previous and git.text("rev-parse", f"{previous}^{{tree}}") == root:
        return None
    parents = ["-p", previous] if previous else []
    return git.text("commit-tree", root, *parents, "-m", f"Pages of {commit}", more=AUTHOR)


def _files(git: Git, tree: str) -> dict[str, tuple[str, str]]:
    """Mode and git's name of the content of each file of a tree, by path."""
    listing = git.output("ls-tree", "-r", "-z", tree, limit=_MAX_LISTING)
    found = {}
    for line in filter(None, listing.decode().split("\0")):
        about, _, name = line.partition("\t")
        mode, _, sha = about.split(" ")
        found[name] = mode, sha
    return found


def _require_published(
    listed: dict[str, tuple[str, str]], before: dict[str, tuple[str, str]]
) -> None:
    """Refuse what lacks a published record, its commands, or a file of a round.

    Signatures go with a leaked key.
    """
    lasting = (canonical.RECORD_SUFFIX, canonical.ACTIONS_SUFFIX, *canonical.ROUND_FILES)
    for name, content in before.items():
        if canonical.named(name) and name.endswith(lasting):
            if name not in listed:
                raise InputError(f"{LEADERBOARD}/{name} was published and is missing")
            if listed[name] != content:
                raise InputError(f"{LEADERBOARD}/{name} is not what was published")


def main() -> int:
    """Make the pages of ``COMMIT`` in this checkout from ``SITE``; see ``publish.yml``."""
    git = Git(Path.cwd())
    previous = git.text("for-each-ref", "--format=%(objectname)", "refs/remotes/origin/gh-pages")
    commit, site = workflow.required("COMMIT"), Path(workflow.required("SITE"))
    if not re.fullmatch(r"[0-9a-f]{40}", commit):
        raise InputError(f"COMMIT is {commit!r}, not the full name of one")
    made = pages(git, commit, site, previous or None)
    workflow.output(commit=made or "")
    workflow.summary(TITLE, [f"pages {made}" if made else "the pages are up to date"])
    return 0


if __name__ == "__main__":
    sys.exit(workflow.run(TITLE, main))
