"""The Python sources of a hostile folder, read without running them: files, imports.

Call :func:`imported_packages` and everything that parses in a limited process, see
:mod:`ventbench.sandbox.reader`; :func:`walk` parses nothing.
"""

from __future__ import annotations

import ast
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

#: File of the controller.
CONTROLLER = "controller.py"

#: Folders below one another that are entered.
DEPTH = 16


def walk(folder: Path) -> Iterator[tuple[Path, list[str], list[str]]]:
    """Walk as ``os.walk`` does, without recursion and not below :data:`DEPTH` folders.

    A folder that lies too deep is named among the files. Names may be removed from the list of
    folders while it walks; links are never followed. For each folder its path, the names of the
    folders in it and of everything else in it.
    """
    waiting = [(Path(folder), 0)]
    while waiting:
        current, depth = waiting.pop()
        try:
            with os.scandir(current) as entries:
                kinds = {entry.name: entry.is_dir() for entry in entries}
        except OSError:
            continue
        folders = sorted(name for name, is_folder in kinds.items() if is_folder and depth < DEPTH)
        names = sorted(kinds.keys() - set(folders))
        yield current, folders, names
        inner = [name for name in folders if not (current / name).is_symlink()]
        waiting += [(current / name, depth + 1) for name in reversed(inner)]


def sources(folder: Path) -> list[Path]:
    """Return all ``.py`` files of a folder that are plain files, sorted; links are left out."""
    paths = (parent / name for parent, _, names in walk(folder) for name in names)
    python = (path for path in paths if path.name.endswith(".py"))
    return sorted(path for path in python if path.is_file() and not path.is_symlink())


class Import(NamedTuple):
    """One imported name."""

    module: str  #: dotted name.
    level: int  #: number of leading dots.
    node: ast.stmt  #: the statement.
    optional: bool  #: whether a failing import is caught.
    late: bool  #: whether it stands in a function.


def imports(body: list[ast.stmt], optional: bool = False, late: bool = False) -> Iterator[Import]:
    """Find the import statements of a module's body, also within other statements."""
    for node in body:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, 0, node, optional, late)
        elif isinstance(node, ast.ImportFrom):
            if node.module:
                yield Import(node.module, node.level, node, optional, late)
            for alias in node.names:  # may be modules themselves
                if node.level or node.module:
                    module = f"{node.module}.{alias.name}" if node.module else alias.name
                    yield Import(module, node.level, node, optional, late)
        else:
            deep = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            caught = isinstance(node, ast.Try) and any(map(_catches, node.handlers))
            for field in ("body", "orelse", "finalbody"):
                inner = getattr(node, field, [])
                guarded = optional or (caught and field == "body")
                yield from imports(inner, guarded, late or deep)
            for part in (*getattr(node, "handlers", ()), *getattr(node, "cases", ())):
                yield from imports(part.body, optional, late)


def _catches(handler: ast.ExceptHandler) -> bool:
    kinds = {"ImportError", "ModuleNotFoundError", "Exception", "BaseException"}
    if handler.type is None:
        return True
    return any(isinstance(node, ast.Name) and node.id in kinds for node in ast.walk(handler.type))


def module_files(imported: Import, name: str) -> Iterator[str]:
    """Name the files that an import may run, on the way to the module and itself, by path."""
    parent = name.split("/")[: -imported.level] if imported.level else []
    parts = [*parent, *imported.module.split(".")]
    for depth in range(len(parent) + 1, len(parts) + 1):
        path = "/".join(parts[:depth])
        yield from (f"{path}.py", f"{path}/__init__.py")


def imported_packages(folder: str) -> list[str]:
    """Return the top-level names that ``controller.py`` of a folder imports, also by its modules.

    Words in comments, docstrings and text count for nothing, and neither do sources that the
    controller does not import. A source that is not Python imports nothing.
    """
    waiting, visited, packages = [CONTROLLER], set(), set()
    while waiting:
        name = waiting.pop()
        path = Path(folder, name)
        if name in visited or path.is_symlink() or not path.is_file():
            continue
        visited.add(name)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                statements = list(imports(ast.parse(path.read_bytes(), name).body))
        except (SyntaxError, ValueError, RecursionError, MemoryError, OSError):
            continue
        absolute = [statement.module for statement in statements if not statement.level]
        packages |= {module.partition(".")[0] for module in absolute}
        waiting += [file for statement in statements for file in module_files(statement, name)]
    return sorted(packages)
