"""Checks of what a submission imports, by its sources alone."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from ventbench.sandbox.packages import OPTIONAL
from ventbench.submissions.findings import Finding
from ventbench.submissions.folder import CONTROLLER

#: Packages beyond the standard library.
ALLOWED = ("numpy", *OPTIONAL)

#: Modules of the standard library that cannot do anything in the sandbox.
_USELESS = {
    **dict.fromkeys(("socket", "ssl", "urllib", "http", "ftplib", "smtplib"), "the network"),
    **dict.fromkeys(("socketserver", "xmlrpc", "imaplib", "poplib", "webbrowser"), "the network"),
    **dict.fromkeys(("subprocess", "multiprocessing", "pty"), "other processes"),
    **dict.fromkeys(("shelve", "dbm", "sqlite3", "tempfile", "shutil"), "files to write"),
    **dict.fromkeys(("ctypes", "_ctypes", "ptrace"), "memory beside its own"),
}
_SANDBOX = "leave it out: a submission has its folder to read, its observations, and nothing else"
_LATE = "import it at the top of the file; later the folder is not searched any more"


class _Import(NamedTuple):
    """One imported name."""

    module: str
    level: int
    node: ast.stmt
    optional: bool
    late: bool


def check(trees: Mapping[str, ast.Module]) -> list[Finding]:
    """Follow the imports from ``controller.py`` on.

    Args:
        trees: of all sources, by path below the folder; the controller's among them.
    """
    own = {name.partition("/")[0].removesuffix(".py") for name in trees}
    waiting, seen, found = [CONTROLLER], set(), []
    while waiting:
        name = waiting.pop()
        if name in seen or name not in trees:
            continue
        seen.add(name)
        for item in _imports(trees[name].body):
            finding = _judged(item, name, own)
            if finding is not None:
                found.append(finding)
            waiting += _files(item, name)
    return list(dict.fromkeys(found))  # `from a import b` may be two modules


def _imports(body: list[ast.stmt], optional: bool = False, late: bool = False) -> Iterator[_Import]:
    for node in body:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield _Import(alias.name, 0, node, optional, late)
        elif isinstance(node, ast.ImportFrom):
            if node.module:
                yield _Import(node.module, node.level, node, optional, late)
            for alias in node.names:  # may be modules themselves
                if node.level or node.module:
                    module = f"{node.module}.{alias.name}" if node.module else alias.name
                    yield _Import(module, node.level, node, optional, late)
        else:
            deep = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            caught = isinstance(node, ast.Try) and any(map(_catches, node.handlers))
            for field in ("body", "orelse", "finalbody"):
                inner = getattr(node, field, [])
                guarded = optional or (caught and field == "body")
                yield from _imports(inner, guarded, late or deep)
            for part in (*getattr(node, "handlers", ()), *getattr(node, "cases", ())):
                yield from _imports(part.body, optional, late)


def _catches(handler: ast.ExceptHandler) -> bool:
    kinds = {"ImportError", "ModuleNotFoundError", "Exception", "BaseException"}
    if handler.type is None:
        return True
    return any(isinstance(node, ast.Name) and node.id in kinds for node in ast.walk(handler.type))


def _judged(item: _Import, name: str, own: set[str]) -> Finding | None:
    top, what = item.module.partition(".")[0], ""
    if item.level:
        if "/" in name:
            return None
        what, advice = "uses a relative import, and is not in a package", "leave out the dot"
    elif top in own:
        if not item.late or item.optional:
            return None
        what, advice = f"imports {top} inside a function", _LATE
    elif top in _USELESS:
        what, advice = f"imports {top}, but the sandbox closes {_USELESS[top]}", _SANDBOX
    elif top in ALLOWED or top in sys.stdlib_module_names:
        return None
    elif top == "ventbench":
        what = "imports ventbench, which a submission does not have"
        advice = "copy what it needs into the folder; task and observation come by themselves"
    else:
        what = f"imports {top}, which is neither in the folder nor among the packages it may use"
        advice = f"use {', '.join(ALLOWED)} and the standard library"
    place = item.node.lineno, item.node.col_offset + 1
    return Finding("source", name, what, advice, *place, problem=not item.optional)


def _files(item: _Import, name: str) -> Iterator[str]:
    """Paths that a module of the folder may have, on the way to it and itself."""
    parent = name.split("/")[: -item.level] if item.level else []
    parts = [*parent, *item.module.split(".")]
    for depth in range(len(parent) + 1, len(parts) + 1):
        path = "/".join(parts[:depth])
        yield from (f"{path}.py", f"{path}/__init__.py")
