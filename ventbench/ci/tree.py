"""The files of a submission's git tree: plain, small, and with names that deceive nobody."""

from __future__ import annotations

from typing import NamedTuple

from ventbench.ci.errors import TakeError
from ventbench.ci.git import Git, GitError
from ventbench.submissions import paths
from ventbench.submissions.folder import MAX_BYTES, MAX_FILES

_MODES = {
    "100644": "",
    "100755": "is executable; chmod -x it and commit again",
    "120000": "is a symbolic link; put the file itself there",
    "160000": "is a submodule; put the files themselves there",
}


class Entry(NamedTuple):
    """A file of a tree: git's mode and name of it, and its path."""

    mode: str
    sha: str
    path: str


def entries(git: Git, tree: str) -> list[Entry]:
    """List the files of a tree.

    Args:
        git: repository that has it.
        tree: git's name of it.

    Raises:
        TakeError: if there is no end of them, or one is not where its name says.
    """
    try:
        listing = git.output("ls-tree", "-r", "-t", "-z", "--full-tree", tree)
    except GitError as error:
        raise TakeError(f"the submission's files cannot be listed: {error}") from None
    found, folders = [], {""}
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
            found.append(Entry(mode, sha, path))
    return found


def problems(files: list[Entry]) -> list[str]:
    """Say what is wrong with the names and modes of files.

    Args:
        files: of one submission.
    """
    names = [entry.path for entry in files]
    found = []
    if len(names) > MAX_FILES:
        return [f"the folder has {len(names)} files; at most {MAX_FILES} are accepted"]
    for mode, _, path in files:
        for wrong in (_MODES.get(mode, f"has mode {mode}"), paths.problem(path)):
            if wrong:
                found.append(f"{path} {wrong}")
        advice = paths.refused(path)
        if advice:
            found.append(f"{path} is of a kind that is not accepted; {advice}")
    found += [f"{path} is there twice" for path in sorted({p for p in names if names.count(p) > 1})]
    pairs = paths.collisions(names)
    return found + [f"{a} and {b} differ only in upper and lower case" for a, b in pairs]


def contents(git: Git, files: list[Entry]) -> dict[str, bytes]:
    """Return the contents of files by path.

    Args:
        git: repository that has them.
        files: without problems.

    Raises:
        TakeError: if they are too large, or not files.
    """
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
    found, at = {}, 0
    for entry in files:
        end = data.index(b"\n", at)
        size = int(data[at:end].split(b" ")[2])
        found[entry.path] = data[end + 1 : end + 1 + size]
        at = end + 1 + size + 1  # git ends each with a line feed
    return found
