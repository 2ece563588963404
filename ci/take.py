"""A submission out of an exact commit: its plain, small files, and nothing else of that commit.

Git hands over names and contents of objects. They are checked before anything is written: the
commit may change ``submissions/NAME/`` alone, and no name or mode there may deceive anybody.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from ci.git import Git, GitError, fetch
from ventbench.base.errors import InputError
from ventbench.entries.folder import MAX_BYTES, MAX_FILES, collisions, kind_problem, path_problem
from ventbench.entries.manifest import NAME, NAME_RULE
from ventbench.sandbox.child.cell import printable

#: Folder of all submissions in the repository.
PARENT = "submissions"

_COMMIT = re.compile(r"[0-9a-f]{40}")
#: Problems named in one message; a hostile tree can have millions.
_MAX_PROBLEMS = 20
_MODE_PROBLEMS = {
    "100644": "",
    "100755": "is executable; chmod -x it and commit again",
    "120000": "is a symbolic link; put the file itself there",
    "160000": "is a submodule; put the files themselves there",
}


class TakeError(InputError):
    """A submission that cannot be taken from its commit.

    Attributes:
        problems: one sentence for each.
    """

    def __init__(self, *problems: str):
        lines = [printable(problem, 500) for problem in problems[:_MAX_PROBLEMS]]
        if len(problems) > _MAX_PROBLEMS:
            lines.append(f"and {len(problems) - _MAX_PROBLEMS} more problems")
        self.problems = tuple(lines)
        super().__init__("\n".join(lines))


@dataclass(frozen=True)
class Taken:
    """Where a submission comes from, and where its files are now.

    Attributes:
        folder: with its files.
        name: of the submission.
        commit: that held it.
        tree: git's name of the folder's content.
    """

    folder: Path
    name: str
    commit: str
    tree: str


class TreeEntry(NamedTuple):
    """A file of a tree: git's mode and name of it, and its path."""

    mode: str
    sha: str
    path: str


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
        GitError: if the commit cannot be fetched.
    """
    name = submission_name(name)
    base, commit = commit_name(base, "base"), commit_name(commit)
    with tempfile.TemporaryDirectory() as folder:
        git = fetch(Path(folder), source, (base, commit), MAX_BYTES)
        problems = [
            f"{path} is changed as well; a pull request changes {PARENT}/{name}/ alone"
            for path in _changes_outside(git, base, commit, name)
        ]
        tree = _tree_at(git, f"{commit}:{PARENT}/{name}")
        if tree is None:
            raise TakeError(*problems, f"commit {commit} holds no folder {PARENT}/{name}")
        entries = _tree_entries(git, tree)
        problems += _entry_problems(entries)
        if problems:
            raise TakeError(*problems)
        contents = _contents(git, entries)
    folder = out / name
    folder.mkdir(parents=True)
    for path, content in contents.items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with open(target, "xb") as file:
            file.write(content)
    return Taken(folder, name, commit, tree)


def changed_submissions(source: str, base: str, commit: str) -> list[str]:
    """Names of the submissions that a pull request changes or adds.

    Args:
        source: URL or path of the repository.
        base: commit that the pull request is meant for.
        commit: its last one.

    Raises:
        InputError: if one is no commit, cannot be fetched, or they have no common history.
    """
    base, commit = commit_name(base, "base"), commit_name(commit)
    with tempfile.TemporaryDirectory() as folder:
        git = fetch(Path(folder), source, (base, commit), MAX_BYTES)
        fork = _fork_point(git, base, commit)
        empty = _empty_tree(git)
        trees = [_tree_at(git, f"{name}:{PARENT}") or empty for name in (fork, commit)]
        names = [path.decode(errors="backslashreplace") for path in _differing(git, *trees)]
        return sorted(name for name in names if _tree_at(git, f"{commit}:{PARENT}/{name}"))


def _changes_outside(git: Git, base: str, commit: str, name: str) -> list[str]:
    """Files and folders beside ``submissions/NAME`` that differ from where the branch left base.

    Folder by folder, not recursively: git would collect all of an endless tree first.
    """
    fork = _fork_point(git, base, commit)
    parent, kept = PARENT.encode(), name.encode()
    changed = _differing(git, fork, commit) - {parent}
    before, after = (_tree_at(git, f"{end}:{PARENT}") for end in (fork, commit))
    if after is not None:
        below = _differing(git, before or _empty_tree(git), after) - {kept}
        changed |= {parent + b"/" + path for path in below}
    return sorted(path.decode(errors="backslashreplace") for path in changed)


def _fork_point(git: Git, base: str, commit: str) -> str:
    for name in (base, commit):
        if git.text("cat-file", "-t", name) != "commit":
            raise TakeError(f"{name} is not a commit")
    try:
        return git.text("merge-base", base, commit)
    except GitError:
        raise TakeError(f"commit {commit} has no history in common with {base}") from None


def _differing(git: Git, before: str, after: str) -> set[bytes]:
    try:
        listing = git.output("diff-tree", "-z", "--no-renames", "--name-only", before, after)
    except GitError as error:
        raise TakeError(f"what {after} changes cannot be listed: {error}") from None
    return {path for path in listing.split(b"\0") if path}


def _tree_at(git: Git, place: str) -> str | None:
    """Return git's name of the folder at ``COMMIT:PATH``; None if there is none."""
    try:
        sha = git.text("rev-parse", "--verify", "--quiet", "--end-of-options", place)
        return sha if git.text("cat-file", "-t", sha) == "tree" else None
    except GitError:
        return None


def _empty_tree(git: Git) -> str:
    return git.text("hash-object", "-t", "tree", "-w", "--stdin")


def _tree_entries(git: Git, tree: str) -> list[TreeEntry]:
    """List the files of a tree; refuse one that has no end, or names that lead elsewhere."""
    try:
        listing = git.output("ls-tree", "-r", "-t", "-z", "--full-tree", tree)
    except GitError as error:
        raise TakeError(f"the submission's files cannot be listed: {error}") from None
    files, folders = [], {""}
    for line in listing.split(b"\0"):
        if not line:
            continue
        about, _, name = line.partition(b"\t")
        mode, kind, sha = about.decode().split(" ")
        path = name.decode(errors="backslashreplace")
        if path.rpartition("/")[0] not in folders:
            raise TakeError(f"{path} is a name with a slash in it, not a file in a folder")
        if kind == "tree":
            folders.add(path)
        else:
            files.append(TreeEntry(mode, sha, path))
    return files


def _entry_problems(files: list[TreeEntry]) -> list[str]:
    names = [entry.path for entry in files]
    if len(names) > MAX_FILES:
        return [f"the folder has {len(names)} files; at most {MAX_FILES} are accepted"]
    problems = []
    for mode, _, path in files:
        mode_and_path = (_MODE_PROBLEMS.get(mode, f"has mode {mode}"), path_problem(path))
        problems.extend(f"{path} {wrong}" for wrong in mode_and_path if wrong)
        advice = kind_problem(path)
        if advice:
            problems.append(f"{path} is of a kind that is not accepted; {advice}")
    twice = sorted({path for path in names if names.count(path) > 1})
    problems += [f"{path} is there twice" for path in twice]
    pairs = collisions(names)
    return problems + [f"{a} and {b} differ only in upper and lower case" for a, b in pairs]


def _contents(git: Git, files: list[TreeEntry]) -> dict[str, bytes]:
    """Return the contents of files by path; their sizes are asked for first."""
    wanted = "".join(f"{entry.sha}\n" for entry in files).encode()
    lines = git.output("cat-file", "--batch-check", given=wanted).decode().splitlines()
    total = 0
    for entry, line in zip(files, lines, strict=True):
        _, kind, *size = line.split(" ")
        if kind == "missing":
            raise TakeError(f"{entry.path} has over {MAX_BYTES / 1e6:g} MB")
        if kind != "blob":
            raise TakeError(f"{entry.path} is a {kind} in place of a file")
        total += int(size[0])
    if total > MAX_BYTES:
        raise TakeError(
            f"the folder has {total / 1e6:.1f} MB; at most {MAX_BYTES / 1e6:g} MB are accepted"
        )
    limit = MAX_BYTES + 100 * len(files)
    data = git.output("cat-file", "--batch", given=wanted, limit=limit)
    contents, at = {}, 0
    for entry in files:
        end = data.index(b"\n", at)
        size = int(data[at:end].split(b" ")[2])
        contents[entry.path] = data[end + 1 : end + 1 + size]
        at = end + 1 + size + 1  # git ends each with a line feed
    return contents
