"""A submission out of an exact commit: its plain files, and nothing else of that commit."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from ventbench.ci import tree
from ventbench.ci.changes import PARENT, outside, tree_at
from ventbench.ci.errors import TakeError, commit_name, submission_name
from ventbench.ci.git import fetched
from ventbench.submissions.folder import MAX_BYTES


@dataclass(frozen=True)
class Taken:
    """Where a submission comes from, and where it now lies.

    Attributes:
        folder: with its files.
        name: of it.
        commit: that held it.
        tree: git's name of the folder's content.
    """

    folder: Path
    name: str
    commit: str
    tree: str


def take(source: str, base: str, commit: str, name: str, out: Path) -> Taken:
    """Fetch a commit, check what it changes, and write out one submission.

    Args:
        source: URL or path of the repository.
        base: commit that the change is meant for.
        commit: with the submission.
        name: of the submission.
        out: ``out/name`` is made.

    Raises:
        TakeError: naming every problem of the commit; nothing is written then.
        GitError: if it cannot be fetched.
    """
    name = submission_name(name)
    base, commit = commit_name(base, "base"), commit_name(commit)
    with tempfile.TemporaryDirectory() as folder:
        git = fetched(Path(folder), source, (base, commit), MAX_BYTES)
        problems = [
            f"{path} is changed as well; a pull request changes {PARENT}/{name}/ alone"
            for path in outside(git, base, commit, name)
        ]
        found = tree_at(git, f"{commit}:{PARENT}/{name}")
        if found is None:
            raise TakeError(*problems, f"commit {commit} holds no folder {PARENT}/{name}")
        files = tree.entries(git, found)
        problems += tree.problems(files)
        if problems:
            raise TakeError(*problems)
        contents = tree.contents(git, files)
    folder = out / name
    folder.mkdir(parents=True)
    for path, content in contents.items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with open(target, "xb") as file:
            file.write(content)
    return Taken(folder, name, commit, found)
