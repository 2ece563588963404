"""What is said of a new record when it is added: which one it corrects, where it came from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ventbench import files
from ventbench.board import canonical, record
from ventbench.errors import InputError


def amend(
    path: Path,
    *,
    supersedes: str | None = None,
    reason: str = "",
    source: Mapping[str, str] | None = None,
) -> Path:
    """Write a new record beside another one that no leaderboard holds yet.

    Args:
        path: of the record; its commands lie beside it.
        supersedes: SHA-256 of the record that it corrects.
        reason: why, for the page.
        source: where the submission came from, such as its commit; joins what is there.

    Returns:
        The new record's path; ``path`` itself if there is nothing to change.

    Raises:
        InputError: if it is not a record of a score.
        OSError: if a file cannot be read or written.
    """
    if not isinstance(record.load(path), record.Record):
        raise InputError(f"{path} is not the record of a score")
    values = canonical.parse(path.read_bytes(), str(path))
    if supersedes is not None:
        values["supersedes"] = supersedes
    if reason:
        values["reason"] = reason
    values["provenance"] = {**values["provenance"], **(source or {})}
    content = canonical.canonical(values)
    record.from_bytes(content, f"{path}, amended")
    new = path.parent / f"{canonical.digest(content)}{record.SUFFIX}"
    if content != path.read_bytes():
        files.write_atomically(new, lambda file: file.write(content))
        return new
    return path
