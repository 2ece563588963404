"""The file of a record's commands: where it lies, and that it is the right one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ventbench.board import actions, canonical
from ventbench.board.record import Record
from ventbench.errors import InputError


def path_of(record: Record, folder: Path) -> Path:
    """Where the commands of a record lie."""
    return folder / f"{record.content['actions']['sha256']}{actions.SUFFIX}"


def load(record: Record, folder: Path) -> NDArray[np.float64]:
    """Read the commands of a record.

    Args:
        record: whose they are.
        folder: that holds the file.

    Returns:
        %, shape ``(L, 1 + K, P, BREATHS, INSPIRATION_STEPS)``.

    Raises:
        InputError: if the file is missing, or not the one that the record names.
    """
    path, about = path_of(record, folder), record.content["actions"]
    if not path.is_file() or path.is_symlink():
        raise InputError(f"{path} is missing: the commands of record {record.sha256[:12]}")
    if path.stat().st_size > actions.MOST_BYTES:
        raise InputError(f"{path} is larger than {actions.MOST_BYTES / 1e6:g} MB")
    content = path.read_bytes()
    found = canonical.digest(content)
    if found != about["sha256"]:
        raise InputError(f"{path} has been changed: its SHA-256 is {found}")
    if len(content) != about["bytes"]:
        raise InputError(f"record {record.sha256}, key actions.bytes: {path} has {len(content)}")
    return actions.decode(content, about["shape"], str(path))
