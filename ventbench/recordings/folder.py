"""Finding the folder of public recordings, which are never part of the checkout."""

from __future__ import annotations

import os
from pathlib import Path

VARIABLE = "VENTBENCH_RECORDINGS"


def recordings_dir() -> Path | None:
    """Find the folder.

    Returns:
        The folder that the environment variable `VENTBENCH_RECORDINGS` names; if it is not set,
        the first `shared/recordings` in or beside the current folder, the checkout or a folder
        above them. None if there is no such folder, also if the variable names none.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named) if Path(named).is_dir() else None
    for base in (Path.cwd(), Path(__file__).resolve().parents[2]):
        for above in (base, *base.parents):
            folder = above / "shared" / "recordings"
            if folder.is_dir():
                return folder
    return None
