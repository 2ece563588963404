"""Lets modules of a submission be imported from their sources alone.

What was reviewed and hashed is then what runs: no ``__pycache__`` that says something else, no
compiled extension.
"""

from __future__ import annotations

import sys
from importlib.machinery import FileFinder, SourceFileLoader
from pathlib import Path
from types import CodeType


class _Loader(SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)


def only_sources(folder: Path) -> None:
    """Put this rule into force for a folder and all below."""

    def hook(path: str) -> FileFinder:
        if not Path(path).is_relative_to(folder):
            raise ImportError(path)
        return FileFinder(path, (_Loader, [".py"]))

    sys.path_hooks.insert(0, hook)
