"""Checks of the files of a submission; nothing is run or imported."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

from ventbench.submissions import paths, weights_check
from ventbench.submissions.findings import Finding
from ventbench.submissions.folder import CONTROLLER, MANIFEST, MAX_BYTES, MAX_FILES

_README = "README.md"
_REQUIRED = {
    CONTROLLER: "write it with a class Controller; `ventbench new` shows one",
    MANIFEST: "write it; `ventbench new` shows one, submissions/README.md explains the keys",
    _README: "say in a few sentences what it does and how it was made",
}


def check(folder: Path) -> list[Finding]:
    """Look at every file of a submission.

    Args:
        folder: of the submission.
    """
    found: list[Finding] = []
    sizes: dict[str, int] = {}
    for path in _walk(folder):
        name = path.relative_to(folder).as_posix()
        if len(sizes) >= MAX_FILES:
            advice = "put what belongs together into one file"
            found.append(_problem("the folder", f"has more than {MAX_FILES} files", advice))
            break
        status = path.lstat()
        if stat.S_ISREG(status.st_mode):
            sizes[name] = status.st_size
            found += _file(path, name, status)
        else:
            found.append(_irregular(name, status.st_mode))
    found += _size(sizes)
    for one, other in paths.collisions(sizes):
        what = f"differs from {one} only in upper and lower case"
        found.append(_problem(other, what, "rename one of them"))
    return found + list(_required(folder))


def _problem(file: str, what: str, advice: str) -> Finding:
    return Finding("files", file, what, advice)


def _note(file: str, what: str, advice: str) -> Finding:
    return Finding("files", file, what, advice, problem=False)


def _walk(folder: Path) -> Iterator[Path]:
    """Files, links, and hidden folders as one each; what Python caches is left out."""
    for parent, folders, names in os.walk(folder):
        here = Path(parent)
        closed = [n for n in folders if (here / n).is_symlink() or n.startswith(".")]
        folders[:] = sorted(set(folders) - {"__pycache__"} - set(closed))
        yield from (here / name for name in sorted((*closed, *names)))


def _irregular(name: str, mode: int) -> Finding:
    if stat.S_ISLNK(mode):
        advice = "put the file itself there; nothing outside of the folder can be read anyway"
        return _problem(name, "is a symbolic link", advice)
    if stat.S_ISDIR(mode):
        return _problem(name, "is a hidden folder", "move or remove it")
    return _problem(name, "is neither a file nor a folder", "remove it")


def _file(path: Path, name: str, status: os.stat_result) -> Iterator[Finding]:
    if path.name == ".DS_Store":
        yield _note(name, "was written by macOS", "leave it out of the pull request")
        return
    wrong, advice = paths.problem(name), paths.refused(name)
    if wrong:
        rename = "rename or remove it: a pull request that holds it is refused"
        yield _problem(name, wrong, rename)
    elif advice:
        yield _problem(name, "is of a kind that is not accepted", advice)
    elif status.st_size <= MAX_BYTES:  # a larger one is a problem already
        yield from _content(path, name)
    if os.name != "nt" and status.st_mode & 0o111:
        refused = f"chmod -x {name}: a pull request with executables is refused"
        yield _note(name, "is executable", refused)


def _content(path: Path, name: str) -> Iterator[Finding]:
    try:
        content = path.read_bytes()
    except OSError as error:
        yield _problem(name, f"cannot be read: {error.strerror}", "make it readable")
        return
    if content.startswith(b"version https://git-lfs"):
        advice = "commit the file itself, without LFS"
        yield _problem(name, "is a pointer of git LFS, not the file", advice)
    elif paths.ending(name) in paths.ARRAYS:
        for what in weights_check.problems(path):
            yield _problem(name, what, weights_check.ADVICE[paths.ending(name)])
    elif paths.ending(name) not in paths.PICTURES:
        yield from _text(content, name)


def _text(content: bytes, name: str) -> Iterator[Finding]:
    try:
        clean = "\0" not in content.decode()
    except UnicodeDecodeError:
        clean = False
    if not clean and not name.endswith((".py", ".toml")):  # those are told with what they hold
        yield _problem(name, "is not UTF-8 text", "save it as UTF-8, or leave it out")


def _size(sizes: dict[str, int]) -> Iterator[Finding]:
    total = sum(sizes.values())
    if total > MAX_BYTES:
        largest = sorted(sizes, key=lambda name: -sizes[name])[:3]
        listed = ", ".join(f"{name} ({sizes[name] / 1e6:.1f} MB)" for name in largest)
        yield _problem(
            "the folder",
            f"has {total / 1e6:.1f} MB; at most {MAX_BYTES / 1e6:g} MB are accepted",
            f"the largest are {listed}; float32 or float16 weights take less",
        )


def _required(folder: Path) -> Iterator[Finding]:
    for name, advice in _REQUIRED.items():
        path = folder / name
        if not path.is_file():
            close = [p.name for p in folder.iterdir() if p.name.lower() == name.lower()]
            hint = f"; {close[0]} is there: rename it" if close and close[0] != name else ""
            yield _problem(name, f"is missing{hint}", advice)
        elif path.stat().st_size == 0:
            yield _problem(name, "is empty", advice)
