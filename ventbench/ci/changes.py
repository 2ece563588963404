"""What a commit changes, seen from where its branch left the base."""

from __future__ import annotations

from ventbench.ci.errors import TakeError
from ventbench.ci.git import Git, GitError

#: Folder of all submissions in the repository.
PARENT = "submissions"


def outside(git: Git, base: str, commit: str, name: str) -> list[str]:
    """Files and folders beside ``submissions/NAME`` that differ from where the branch left base.

    Folder by folder, not recursively: git would collect all of an endless tree first.

    Raises:
        TakeError: if one is no commit, or they have no common history.
    """
    left = _branched(git, base, commit)
    kept = PARENT.encode(), name.encode()
    found = _differing(git, left, commit) - {kept[0]}
    inside = [tree_at(git, f"{one}:{PARENT}") for one in (left, commit)]
    if inside[1] is not None:
        empty = git.text("hash-object", "-t", "tree", "-w", "--stdin")
        below = _differing(git, inside[0] or empty, inside[1]) - {kept[1]}
        found |= {kept[0] + b"/" + path for path in below}
    return sorted(path.decode(errors="backslashreplace") for path in found)


def changed_submissions(git: Git, base: str, commit: str) -> list[str]:
    """Names of the submissions that differ, or that a commit adds.

    Raises:
        TakeError: as :func:`outside`.
    """
    left = _branched(git, base, commit)
    empty = git.text("hash-object", "-t", "tree", "-w", "--stdin")
    trees = [tree_at(git, f"{one}:{PARENT}") or empty for one in (left, commit)]
    names = [path.decode(errors="backslashreplace") for path in _differing(git, *trees)]
    return sorted(name for name in names if tree_at(git, f"{commit}:{PARENT}/{name}"))


def _branched(git: Git, base: str, commit: str) -> str:
    for one in (base, commit):
        if git.text("cat-file", "-t", one) != "commit":
            raise TakeError(f"{one} is not a commit")
    try:
        return git.text("merge-base", base, commit)
    except GitError:
        raise TakeError(f"commit {commit} has no history in common with {base}") from None


def _differing(git: Git, one: str, other: str) -> set[bytes]:
    try:
        listing = git.output("diff-tree", "-z", "--no-renames", "--name-only", one, other)
    except GitError as error:
        raise TakeError(f"what {other} changes cannot be listed: {error}") from None
    return {path for path in listing.split(b"\0") if path}


def tree_at(git: Git, place: str) -> str | None:
    """Return git's name of the folder at ``COMMIT:PATH``; None if there is none."""
    try:
        found = git.text("rev-parse", "--verify", "--quiet", "--end-of-options", place)
        return found if git.text("cat-file", "-t", found) == "tree" else None
    except GitError:
        return None
