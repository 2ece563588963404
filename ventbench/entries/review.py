"""What a reviewer should look at: what a controller seldom needs, with file and line.

None of it is forbidden, and the sandbox does not rest on it. But each of these has served an
attack, and a reader of a pull request should see them all without searching.

:func:`inspect_folder` finds all that reading a folder shows in a limited process, which runs none
of it.

Sources must be Python, and what the controller imports must be there. The class ``Controller`` is
for the run to look at, see :mod:`ventbench.entries.contract`.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import io
import re
import sys
import tokenize
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ventbench.entries.folder import CONTROLLER, MAX_BYTES, check_files
from ventbench.entries.manifest import RULES, Finding, Group, by_word, check_manifest
from ventbench.sandbox.child.cell import source_text
from ventbench.sandbox.child.sources import Import, imports, module_files, sources
from ventbench.sandbox.pipes import OPTIONAL
from ventbench.sandbox.reader import UnreadableError, read_apart


def check_sources(folder: Path) -> list[Finding]:
    """Find what is wrong with the sources of a folder, and note what a reviewer should look at.

    What is imported matters in ``controller.py`` and all of the folder's modules that it imports;
    other sources, such as the training's, need only be Python. Call it in a limited process, see
    :mod:`ventbench.sandbox.reader`.
    """
    findings, trees = [], {}
    for path in sources(folder):
        name = path.relative_to(folder).as_posix()
        if path.stat().st_size > MAX_BYTES:
            continue  # reported by check_files
        tree = _parsed(path, name)
        if isinstance(tree, Finding):
            findings.append(tree)
        else:
            trees[name] = tree
            findings += _notes(path, name, tree)
    if CONTROLLER in trees:
        try:
            findings += _check_imports(trees)
        except RecursionError:
            advice = "write a loop or a table in place of so many nested expressions"
            findings.append(
                Finding("source", CONTROLLER, "is nested too deeply to be read", advice)
            )
    return sorted(findings, key=lambda f: (f.file != CONTROLLER, f.file, f.line or 0))


def _parsed(path: Path, name: str) -> ast.Module | Finding:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of doubtful escapes and the like
            content = path.read_bytes()
            encoding = _declared(content)
            if encoding not in ("utf-8", "utf-8-sig"):
                message = f"names the encoding {encoding}, and is read as UTF-8"
                return Finding(
                    "source", name, message, "save it as UTF-8, and leave out the name", 1
                )
            return ast.parse(source_text(content), name)
    except SyntaxError as error:
        message = f"is not Python: {error.msg}"
        advice = "python -m py_compile shows the place"
        return Finding("source", name, message, advice, error.lineno, error.offset or None)
    except (ValueError, RecursionError, MemoryError, OSError) as error:
        return Finding("source", name, f"is not Python: {error}", "save it as plain UTF-8 text")


def _declared(content: bytes) -> str:
    """Encoding that a source names in its first two lines."""
    try:
        return tokenize.detect_encoding(io.BytesIO(content).readline)[0]
    except SyntaxError:
        return "of no known name"


#: Packages beyond the standard library.
ALLOWED = ("numpy", *OPTIONAL)

#: Modules of the standard library that cannot do anything in the sandbox, with what it closes.
_USELESS = by_word(RULES["closed"])
_SANDBOX = "leave it out: a submission has its folder to read, its observations, and nothing else"
_LATE = "import it at the top of the file; later the folder is not searched any more"


def _check_imports(trees: Mapping[str, ast.Module]) -> list[Finding]:
    """Follow the imports from ``controller.py`` on, in all parsed sources by path in the folder."""
    local_modules = {name.partition("/")[0].removesuffix(".py") for name in trees}
    waiting, visited, findings = [CONTROLLER], set(), []
    while waiting:
        name = waiting.pop()
        if name in visited or name not in trees:
            continue
        visited.add(name)
        for imported in imports(trees[name].body):
            finding = _import_finding(imported, name, local_modules)
            if finding is not None:
                findings.append(finding)
            waiting += module_files(imported, name)
    return list(dict.fromkeys(findings))  # `from a import b` may be two modules


def _import_finding(imported: Import, name: str, local_modules: set[str]) -> Finding | None:
    top, message = imported.module.partition(".")[0], ""
    if imported.level:
        if "/" in name:
            return None
        message, advice = "uses a relative import, and is not in a package", "leave out the dot"
    elif top in local_modules:
        if not imported.late or imported.optional:
            return None
        message, advice = f"imports {top} inside a function", _LATE
    elif top in _USELESS:
        message, advice = f"imports {top}, but the sandbox closes {_USELESS[top]}", _SANDBOX
    elif top in ALLOWED or top in sys.stdlib_module_names:
        return None
    elif top == "ventbench":
        message = "imports ventbench, which a submission does not have"
        advice = "copy what it needs into the folder; task and observation come by themselves"
    else:
        message = f"imports {top}, which is neither in the folder nor among the packages it may use"
        advice = f"use {', '.join(ALLOWED)} and the standard library"
    place = imported.node.lineno, imported.node.col_offset + 1
    return Finding("source", name, message, advice, *place, problem=not imported.optional)


#: What each module, call and attribute does that a reviewer should look at.
_MODULES, _CALLS, _ATTRIBUTES = (by_word(RULES[k]) for k in ("modules", "calls", "attributes"))
_NAMES = _ATTRIBUTES | _CALLS
_ADVICE = "for the reviewer: make sure that it is what it seems to be"


def _notes(path: Path, name: str, tree: ast.Module) -> list[Finding]:
    """Notes on what a source holds and uses, each once a line."""
    held = _characters(source_text(path.read_bytes()))
    used = (
        (getattr(node, "lineno", None), f"uses {what}, which {why}")
        for node in ast.walk(tree)
        for what, why in _uses(node)
    )
    noted = dict.fromkeys([*held, *used])
    return [Finding("source", name, what, _ADVICE, line, problem=False) for line, what in noted]


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
            quoted = ", ".join(sorted(words))
            yield number, f"holds {quoted}, in letters that may look like others"


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
    elif isinstance(node, ast.Name) and node.id in _NAMES:
        yield node.id, _NAMES[node.id]
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

_CHECKS: Mapping[Group, Callable[[Path], list[Finding]]] = {
    "manifest": check_manifest,
    "files": check_files,
    "source": check_sources,
}


def findings_as_json(folder: str, *checks: Group) -> list[dict[str, Any]]:
    """Make some of :data:`_CHECKS` on a folder, for a process that answers in JSON."""
    listed = []
    for check in checks:
        findings = _CHECKS[check](Path(folder))
        # Problems first: what is cut off must not be what stops the submission.
        limited = sorted(findings, key=lambda finding: not finding.problem)[:LISTED]
        listed += [dataclasses.asdict(finding) for finding in findings if finding in limited]
    return listed


def inspect_folder(folder: Path) -> list[Finding]:
    """Return what is wrong with the manifest, the files and the sources of a submission.

    One process makes all checks. Where a check ends the process, each check gets its own, so that
    the answer says which files cannot be read and still has what the other checks find. Nothing in
    the folder is run or imported.
    """
    function, findings = "ventbench.entries.review:findings_as_json", list[Finding]()
    with contextlib.suppress(UnreadableError):
        return [Finding(**fields) for fields in read_apart(function, folder, [*_CHECKS])]
    for group in _CHECKS:
        try:
            findings += [Finding(**fields) for fields in read_apart(function, folder, [group])]
        except UnreadableError as error:
            advice = "make its files smaller and plainer"
            findings.append(Finding(group, "the folder", str(error), advice))
    return findings
