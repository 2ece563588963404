"""What a reviewer should look at: what a controller seldom needs, with file and line.

None of it is forbidden, and the sandbox does not rest on it. But each of these has served an
attack, and a reader of a pull request should see them all without searching.

:func:`inspect_folder` finds all that reading a folder shows in a limited process, which runs none
of it.
"""

from __future__ import annotations

import ast
import dataclasses
import re
import unicodedata
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ventbench.entries.errors import Finding
from ventbench.entries.file_checks import check_files
from ventbench.entries.manifest import check_manifest
from ventbench.entries.static_checks import check_sources
from ventbench.sandbox.child.cell import source_text
from ventbench.sandbox.child.sources import sources
from ventbench.sandbox.reader import UnreadableError, read_apart

_MODULES = {
    **dict.fromkeys(("gc", "inspect", "traceback"), "looks into Python's own objects and frames"),
    **dict.fromkeys(("ctypes", "mmap", "cffi"), "reaches memory beside Python's objects"),
    **dict.fromkeys(("os", "posix", "fcntl", "resource"), "calls the system"),
    **dict.fromkeys(("signal", "socket", "select", "selectors"), "calls the system"),
    **dict.fromkeys(
        ("threading", "_thread", "concurrent", "asyncio"), "runs beside the controller"
    ),
    **dict.fromkeys(("importlib", "runpy", "pkgutil", "imp", "zipimport"), "imports by name"),
    **dict.fromkeys(("pickle", "marshal", "codeop", "code"), "makes objects or code of bytes"),
    **dict.fromkeys(("time", "datetime"), "sees the clock"),
    "builtins": "changes or finds what Python offers",
}
_CALLS = {
    **dict.fromkeys(("exec", "eval", "compile"), "runs code made of text or bytes"),
    **dict.fromkeys(("__import__", "globals", "locals", "vars"), "finds or imports by name"),
}
_FRAMES = (
    *("_getframe", "_current_frames", "settrace", "setprofile", "f_back", "f_locals"),
    *("f_globals", "tb_frame", "gi_frame", "cr_frame", "ag_frame"),
)
_ATTRIBUTES = {
    **dict.fromkeys(_FRAMES, "looks into frames"),
    **dict.fromkeys(
        ("__subclasses__", "__globals__", "__builtins__"), "finds what it never imported"
    ),
    **dict.fromkeys(("__code__", "CodeType", "FunctionType"), "makes or changes code"),
    **dict.fromkeys(("import_module", "exec_module", "load_module"), "imports by name"),
}
_ADVICE = "for the reviewer: make sure that it is what it seems to be"


def review(folder: Path) -> list[Finding]:
    """List what a reviewer should look at, as notes.

    Call it in a limited process, see :mod:`ventbench.sandbox.reader`.

    Args:
        folder: the submission's.
    """
    notes = []
    for path in sources(folder):
        name = path.relative_to(folder).as_posix()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                text = source_text(path.read_bytes())
                tree = ast.parse(text, name)
        except (SyntaxError, ValueError, RecursionError, MemoryError, OSError):
            continue  # check_sources says so
        notes += [
            Finding("source", name, what, _ADVICE, line, problem=False)
            for line, what in _characters(text)
        ]
        seen = set()
        for node in ast.walk(tree):
            for used, why in _uses(node):
                line = getattr(node, "lineno", None)
                if (used, line) not in seen:
                    seen.add((used, line))
                    what = f"uses {used}, which {why}"
                    notes.append(Finding("source", name, what, _ADVICE, line, problem=False))
    return sorted(notes, key=lambda note: (note.file, note.line or 0))


def _characters(text: str) -> Iterator[tuple[int, str]]:
    """Characters that make a source look like another one: line, and what is there."""
    # As editors count: Python begins a new line after a lone carriage return too.
    for number, line in enumerate(text.split("\n"), 1):
        odd = {c for c in line.rstrip("\r") if unicodedata.category(c) in _UNSEEN and c != "\t"}
        if odd:
            names = ", ".join(sorted(f"U+{ord(c):04X}" for c in odd))
            yield number, f"holds {names}, which is not seen and may hide or move what is"
        words = {word for word in _WORD.findall(line) if not word.isascii()}
        if words:
            shown = ", ".join(sorted(words))
            yield number, f"holds {shown}, in letters that may look like others"


#: Categories of Unicode: control characters, formats (direction, width zero), line separators.
_UNSEEN = ("Cc", "Cf", "Zl", "Zp", "Co", "Cn")
_WORD = re.compile(r"[^\W\d]\w*")


def _uses(node: ast.AST) -> Iterator[tuple[str, str]]:
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield from _module(alias.name)
    elif isinstance(node, ast.ImportFrom):
        if not node.level:
            yield from _module(node.module or "")
        for alias in node.names:
            if alias.name in _ATTRIBUTES:
                yield alias.name, _ATTRIBUTES[alias.name]
    elif isinstance(node, ast.Attribute):
        if node.attr in _ATTRIBUTES:
            yield node.attr, _ATTRIBUTES[node.attr]
    elif isinstance(node, ast.Name) and node.id in _CALLS:
        yield node.id, _CALLS[node.id]
    elif isinstance(node, ast.Name) and node.id in _ATTRIBUTES:
        yield node.id, _ATTRIBUTES[node.id]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        if node.func.attr in ("tobytes", "decode") and isinstance(node.func.value, ast.Subscript):
            yield f".{node.func.attr}()", "makes text or code of an array's bytes"
    elif isinstance(node, ast.Constant) and _is_packed(node.value):
        yield "a long text without spaces", "may be packed data or code"


#: Characters from which a text without spaces is no word.
_LONG = 200


def _is_packed(value: object) -> bool:
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    return isinstance(value, str) and len(value) > max(_LONG, 40 * value.count(" "))


def _module(name: str) -> Iterator[tuple[str, str]]:
    top = name.partition(".")[0]
    if top in _MODULES:
        yield name, _MODULES[top]


#: Most findings of one kind that are listed.
LISTED = 200

_CHECKS = ("manifest", "files", "sources", "review")


def findings_as_json(folder: str, check: str) -> list[dict[str, Any]]:
    """Make one kind of check on a folder, for a process that answers in JSON.

    Args:
        folder: the submission's.
        check: ``"manifest"``, ``"files"``, ``"sources"`` or ``"review"``.
    """
    path = Path(folder)
    if check == "manifest":
        findings = check_manifest(path)[0]
    else:
        checks = {"files": check_files, "sources": check_sources, "review": review}
        findings = checks[check](path)
    # Problems first: what is cut off must not be what stops the submission.
    kept = sorted(findings, key=lambda finding: not finding.problem)[:LISTED]
    return [dataclasses.asdict(finding) for finding in findings if finding in kept]


def all_findings_as_json(folder: str) -> list[dict[str, Any]]:
    """Make every check on a folder, for a process that answers in JSON.

    Args:
        folder: the submission's.
    """
    return [finding for check in _CHECKS for finding in findings_as_json(folder, check)]


def inspect_folder(folder: Path) -> tuple[Finding, ...]:
    """Return what is wrong with the manifest, the files and the sources of a submission.

    One process makes all checks. Where a check ends the process, each check gets its own, so that
    the answer says which files cannot be read and still has what the other checks find.

    Args:
        folder: the submission's; nothing in it is run or imported.
    """
    try:
        together = read_apart("ventbench.entries.review:all_findings_as_json", folder)
        return tuple(Finding(**finding) for finding in together)
    except UnreadableError:
        return _each_apart(folder)


def _each_apart(folder: Path) -> tuple[Finding, ...]:
    findings: list[Finding] = []
    for check in _CHECKS:
        try:
            function = "ventbench.entries.review:findings_as_json"
            answer = read_apart(function, folder, [check])
        except UnreadableError as error:
            group = check if check in ("manifest", "files") else "source"
            advice = "make its files smaller and plainer"
            findings.append(Finding(group, "the folder", str(error), advice))  # type: ignore[arg-type]
            continue
        findings += [Finding(**finding) for finding in answer]
    return tuple(findings)
