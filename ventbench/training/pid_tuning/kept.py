"""Finished parts of a search on disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench import files
from ventbench.errors import InputError

_IDENTITY = "search.json"


class Kept:
    """A folder of arrays, which belongs to one search.

    Args:
        folder: created if missing.
        identity: JSON values that make the search what it is.

    Raises:
        InputError: if the folder belongs to another search.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        self._folder = folder
        path = folder / _IDENTITY
        text = json.dumps(identity, sort_keys=True) + "\n"
        if not path.exists():
            files.write_text(path, text)
        elif path.read_text("utf-8") != text:
            raise InputError(
                f"{folder} holds parts of a search with other gains or simulators; delete it, or "
                "choose another folder with --out"
            )

    def get(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float32] | None:
        """Return a finished part, or None.

        Raises:
            InputError: if the file is not such a part.
        """
        path = self._path(name)
        if not path.exists():
            return None
        try:
            found = np.load(path, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise InputError(f"{path} is damaged, delete it: {error}") from error
        if found.shape != shape or found.dtype != np.float32:
            raise InputError(f"{path} holds {found.dtype} {found.shape}, not float32 {shape}")
        return found

    def put(self, name: str, array: NDArray[np.float32]) -> None:
        """Keep a finished part, in one step."""
        files.write_atomically(self._path(name), lambda file: np.save(file, array))

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.npy"
