"""Names that a submission's files may have: the same on every system, and never a trick."""

from __future__ import annotations

import re
from collections.abc import Iterable

#: Longest path below the submission's folder, characters, and how many names it may have.
MAX_PATH = 120
MAX_DEPTH = 6

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_WINDOWS = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)

#: Endings of text, weights and pictures: all others are refused.
TEXT = {".py", ".toml", ".md", ".txt", ".rst", ".json", ".csv", ".svg", ".cff"}
ARRAYS = {".npz", ".npy", ".safetensors"}
PICTURES = {".png", ".jpg", ".jpeg"}
#: Names without an ending that are accepted as text.
TEXT_NAMES = {"LICENSE", "LICENCE", "COPYING", "NOTICE", "AUTHORS"}

_CODE = "compiled code is not reviewed and not run; submit the Python source"
_PICKLE = "pickles run code when they are read; save arrays as .npz or .safetensors"
_ARCHIVE = "archives are not reviewed; put the files themselves there"
_SCRIPT = "scripts of that kind are never run"
_OTHER = (
    "leave it out: only Python sources, text, pictures (.png, .jpg, .svg) "
    "and weights (.npz, .npy, .safetensors) are accepted"
)
_ADVICE = {
    **dict.fromkeys((".pyc", ".pyo", ".pyd", ".so", ".dll", ".dylib", ".a", ".o", ".exe"), _CODE),
    **dict.fromkeys((".pkl", ".pickle", ".joblib", ".dill", ".pt", ".ckpt", ".h5"), _PICKLE),
    **dict.fromkeys(
        (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".whl", ".egg"), _ARCHIVE
    ),
    **dict.fromkeys((".pth", ".sh", ".bat", ".cmd", ".ps1"), _SCRIPT),
}


def problem(path: str) -> str | None:
    """Say what is wrong with a file's path.

    Args:
        path: below the submission's folder, with ``/`` between names.

    Returns:
        What is wrong, for a sentence that starts with the path; None if nothing is.
    """
    names = path.split("/")
    if len(path) > MAX_PATH or len(names) > MAX_DEPTH:
        return f"is longer than {MAX_PATH} characters or {MAX_DEPTH} names"
    for name in names:
        if name in ("", ".", ".."):
            return "is not a plain path"
        if name.startswith("."):
            return "is a hidden file or folder"
        if name == "__pycache__":
            return "is a cache that Python writes"
        if not name.isascii():
            return f"has other than ASCII characters in its name, {name!a}"
        if not _NAME.fullmatch(name):
            return "may have only letters, digits, '_', '-' and '.' in its name, '-' not first"
        if name.endswith(".") or _WINDOWS.fullmatch(name):
            return "has a name that some systems cannot store"
    return None


def ending(path: str) -> str:
    """Lower-case ending of a path's last name, such as ``".py"``; empty if there is none."""
    name = path.rpartition("/")[2]
    dot = name.rfind(".")
    return name[dot:].lower() if dot > 0 else ""


def refused(path: str) -> str | None:
    """Return what to do about a file of a kind that is not accepted; None if it is accepted."""
    kind = ending(path)
    if kind in TEXT | ARRAYS | PICTURES or path.rpartition("/")[2] in TEXT_NAMES:
        return None
    return _ADVICE.get(kind, _OTHER)


def collisions(paths: Iterable[str]) -> list[tuple[str, str]]:
    """Pairs of files or folders that are one on systems that ignore case.

    Args:
        paths: of all files.
    """
    seen: dict[str, str] = {}
    found = []
    for path in sorted(paths):
        names = path.split("/")
        for depth in range(1, len(names) + 1):
            part = "/".join(names[:depth])
            other = seen.setdefault(part.casefold(), part)
            if other != part:
                found.append((other, part))
    return sorted(set(found))
