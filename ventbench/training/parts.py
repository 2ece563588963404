"""Parts of a long training on disk: what is finished is never computed twice."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ventbench import files
from ventbench.errors import InputError
from ventbench.plants import files as plant_files

_IDENTITY = "training.json"


class Parts:
    """A folder of finished plants, which belongs to one training.

    Args:
        folder: created if missing.
        identity: JSON values that make the training what it is: data, recipe, versions.

    Raises:
        InputError: if the folder belongs to another training.
    """

    def __init__(self, folder: Path, identity: dict[str, Any]) -> None:
        self.folder = folder
        path = folder / _IDENTITY
        text = json.dumps(identity, indent=2, sort_keys=True) + "\n"
        if not path.exists():
            files.write_text(path, text)
        elif path.read_text("utf-8") != text:
            raise InputError(
                f"{folder} holds parts of a training with other recordings, settings or package "
                "versions; delete it, or choose another folder with --out"
            )

    def get(self, name: str, make: Callable[[], Any]) -> Any:
        """Return a plant with numpy leaves; made, and kept, if it is not there."""
        path = self.folder / f"{name}.npz"
        if not path.exists():
            plant_files.save(path, make())
        return plant_files.load(path, as_array=np.asarray)

    def checkpoint(self, name: str) -> Path:
        """Where the making of a part may keep its own state."""
        return self.folder / f"{name}.checkpoint.npz"
