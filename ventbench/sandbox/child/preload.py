"""What every cell finds imported, and the folders from which it may import more."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Iterable

#: Imported once by the zygote, so that cells need not: what small controllers use.
STANDARD = (
    *("abc", "array", "ast", "base64", "bisect", "cmath", "collections.abc", "contextlib", "copy"),
    *("csv", "dataclasses", "decimal", "enum", "fractions", "functools", "hashlib", "heapq"),
    *("inspect", "io", "itertools", "json", "linecache", "logging", "math", "numbers", "operator"),
    *("pathlib", "pickle", "random", "re", "statistics", "string", "struct", "textwrap", "time"),
    *("traceback", "types", "typing", "warnings", "weakref", "zipfile", "zlib", "encodings.cp437"),
)
NUMPY = ("numpy", "numpy.fft", "numpy.linalg", "numpy.polynomial", "numpy.random")

_SITE = ("site-packages", "dist-packages")


def load(packages: Iterable[str], site: Iterable[str]) -> tuple[list[str], list[str]]:
    """Import what cells share, then take the folders of packages off the search path.

    Only packages that are imported here can be imported in a cell: others, ventbench's simulators
    and data among them, are neither on its path nor readable.

    Args:
        packages: modules beyond the standard library; those that are not installed are skipped.
        site: folders of installed packages.

    Returns:
        What a cell may read, and the folders of which it may read the names alone.
    """
    for name in STANDARD:
        importlib.import_module(name)
    standard = [path for path in sys.path if os.path.isdir(path)]
    site = list(site)
    sys.path.extend(site)
    for name in packages:
        with contextlib.suppress(ModuleNotFoundError):
            importlib.import_module(name)
    sys.path[:] = standard
    for path in site:
        sys.path_importer_cache.pop(path, None)
    packages = [folder for path in site for folder in _imported(path)]
    return [*packages, *(entry for path in standard for entry in _entries(path))], standard


def _imported(site: str) -> list[str]:
    """Files and folders of what has been imported from there, with shared libraries beside it."""
    imported = set()
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if file and file.startswith(site + os.sep):
            top = file[len(site) + 1 :].split(os.sep)[0]
            imported |= {top, f"{top}.libs"}
    return sorted(os.path.join(site, name) for name in imported - {"ventbench", "ventbench.libs"})


def _entries(folder: str) -> list[str]:
    """Everything in a folder of the standard library but the packages installed there."""
    return [os.path.join(folder, name) for name in os.listdir(folder) if name not in _SITE]
