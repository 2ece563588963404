"""Checks of the Python sources of a submission, by reading: none of them is run or imported."""

from __future__ import annotations

import ast
import warnings
from pathlib import Path

from ventbench.submissions import class_check, import_check
from ventbench.submissions.findings import Finding
from ventbench.submissions.folder import CONTROLLER, MAX_BYTES


def check(folder: Path) -> list[Finding]:
    """Look at ``controller.py`` and all of the folder's modules that it imports.

    Other sources, such as the training's, need only be Python.

    Args:
        folder: of the submission.
    """
    found, trees = [], {}
    for path in sorted(folder.rglob("*.py")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_BYTES:
            continue  # told with the files
        tree = _parsed(path, name)
        if isinstance(tree, Finding):
            found.append(tree)
        else:
            trees[name] = tree
    if CONTROLLER in trees:
        try:
            found += class_check.check(trees[CONTROLLER])
            found += import_check.check(trees)
        except RecursionError:
            advice = "write a loop or a table in place of so many nested expressions"
            found.append(Finding("source", CONTROLLER, "is nested too deeply to be read", advice))
    return sorted(found, key=lambda one: (one.file != CONTROLLER, one.file, one.line or 0))


def _parsed(path: Path, name: str) -> ast.Module | Finding:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of doubtful escapes and the like
            return ast.parse(path.read_bytes(), name)
    except SyntaxError as error:
        what = f"is not Python: {error.msg}"
        advice = "python -m py_compile shows the place"
        return Finding("source", name, what, advice, error.lineno, error.offset or None)
    except (ValueError, RecursionError, MemoryError, OSError) as error:
        return Finding("source", name, f"is not Python: {error}", "save it as plain UTF-8 text")
