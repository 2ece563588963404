"""Finished pieces of a comparison on disk, so that none is computed twice."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ventbench import files
from ventbench.errors import InputError


class Rows:
    """A folder of finished pieces, a JSON file each.

    Args:
        folder: made when the first piece is finished.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, name: str, identity: Mapping[str, Any], make: Callable[[], Any]) -> Any:
        """Return a piece; made, and kept, if it is not there.

        Args:
            name: of the piece.
            identity: JSON values that make it what it is.
            make: gives JSON values.

        Raises:
            InputError: if the piece that is there is of something else.
        """
        path = self.folder / f"{name}.json"
        wanted = json.loads(json.dumps(identity))
        if path.exists():
            found = json.loads(path.read_text("utf-8"))
            if found["identity"] != wanted:
                raise InputError(
                    f"{path} is of other settings, data or simulators; delete {self.folder}, or "
                    "choose another folder with --out"
                )
            return found["value"]
        value = json.loads(json.dumps(make()))
        files.write_json(path, {"identity": wanted, "value": value})
        return value
