"""Checks of the class ``Controller`` by its source: is it there, and can it be called."""

from __future__ import annotations

import ast
import difflib
from collections.abc import Iterator

from ventbench.submissions.findings import Finding
from ventbench.submissions.folder import CONTROLLER
from ventbench.submissions.load import CLASS

_METHODS = {"reset": "task", "act": "observation"}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def check(tree: ast.Module) -> list[Finding]:
    """Look for the class and its methods.

    Args:
        tree: of ``controller.py``.
    """
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    if CLASS in classes:
        return list(_class(classes[CLASS]))
    if _bound(tree):
        return []  # imported or assigned: the run shows what it is
    close = next(iter(difflib.get_close_matches(CLASS, classes, n=1, cutoff=0.3)), None)
    line = classes[close].lineno if close else None
    hint = f"; did you mean {close}?" if close else ""
    advice = f"call the class {CLASS}" if close else f"write a class {CLASS}; see `ventbench new`"
    return [_problem(f"defines no class {CLASS}{hint}", advice, line)]


def _bound(tree: ast.Module) -> bool:
    """Whether anything but a class statement at the top level may give the name a value."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id == CLASS:
            return True
        if isinstance(node, ast.alias) and (node.asname or node.name) in (CLASS, "*"):
            return True
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == CLASS:
            return True
    return False


def _problem(what: str, advice: str, line: int | None, column: int | None = None) -> Finding:
    return Finding("source", CONTROLLER, what, advice, line, column)


def _class(node: ast.ClassDef) -> Iterator[Finding]:
    methods = {item.name: item for item in node.body if isinstance(item, Function)}
    given = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
    inherits = bool(node.bases or node.keywords or node.decorator_list)
    for name, argument in _METHODS.items():
        if name in methods:
            yield from _method(methods[name], argument)
        elif not inherits and name not in given:
            advice = f"write def {name}(self, {argument})"
            yield _problem(f"class {CLASS} has no method {name}", advice, node.lineno)
    if "__init__" in methods:
        yield from _constructor(methods["__init__"])


def _method(node: Function, argument: str) -> Iterator[Finding]:
    signature = f"def {node.name}(self, {argument})"
    place = node.lineno, node.col_offset + 1
    if isinstance(node, ast.AsyncFunctionDef):
        yield _problem(f"{node.name} is async", f"write {signature}", *place)
        return
    decorators = [d.id if isinstance(d, ast.Name) else "" for d in node.decorator_list]
    if set(decorators) - {"staticmethod", "classmethod"}:
        return  # may change everything
    required, most = _arguments(node)
    wanted = 1 if "staticmethod" in decorators else 2
    if not required <= wanted <= most or _required_keywords(node):
        what = f"{node.name} cannot be called as {node.name}({argument})"
        yield _problem(what, f"write {signature}", *place)
    inside = list(_inside(node))
    if any(isinstance(item, ast.Yield | ast.YieldFrom) for item in inside):
        yield _problem(f"{node.name} is a generator", "return a value, do not yield it", *place)
    elif node.name == "act" and not any(map(_ends, inside)):
        yield _problem("act returns nothing", "return u_in, a number in %", *place)


def _inside(node: ast.AST) -> Iterator[ast.AST]:
    """What a function does itself, not in functions within it."""
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, Function | ast.Lambda | ast.ClassDef):
            yield child
            yield from _inside(child)


def _ends(node: ast.AST) -> bool:
    return isinstance(node, ast.Raise) or (isinstance(node, ast.Return) and node.value is not None)


def _constructor(node: Function) -> Iterator[Finding]:
    required, _ = _arguments(node)
    if required > 1 or _required_keywords(node):
        what = f"{CLASS}() needs arguments that it does not get"
        advice = "give them defaults, or prepare in reset(self, task)"
        yield _problem(what, advice, node.lineno, node.col_offset + 1)


def _arguments(node: Function) -> tuple[int, float]:
    """Fewest and most positional arguments, ``self`` among them."""
    names = [*node.args.posonlyargs, *node.args.args]
    return len(names) - len(node.args.defaults), float("inf") if node.args.vararg else len(names)


def _required_keywords(node: Function) -> bool:
    return any(default is None for default in node.args.kw_defaults)
