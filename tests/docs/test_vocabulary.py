"""Command line and Python call one thing by one name, but for what the glossary lists."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import pytest
import typer.main

import ventbench
from ventbench.cli import app

ROOT = Path(__file__).parents[2]

#: Functions of commands, and options about files, of which functions take or return content.
FUNCTIONS = {
    "diagnose": "diagnose",  # and with --isolability:
    "diagnose --isolability": "isolability",
    "data open-loop": "open_loop",
    "data import": "import_recording",
    "simulate": "simulate_breaths",
    "train pid": "tune_pid",
}
FILES = {"help", "json", "out", "clip", "pad", "missing", "report", "isolability"}


def options(command: str) -> set[str]:
    """Options of a command, without dashes before them."""
    found: Any = typer.main.get_command(app)
    for part in command.split():
        found = found.commands[part]
    return {option[2:] for p in found.params for option in p.opts if option.startswith("--")}


def parameters(function: str) -> set[str]:
    """Parameters of a public function, read from its source."""
    module, name = ventbench._SOURCES[function]
    path = ROOT / "ventbench" / module.replace(".", "/")
    files = [path.with_suffix(".py")] if path.with_suffix(".py").is_file() else path.rglob("*.py")
    (node,) = (
        node
        for file in files
        for node in ast.parse(file.read_text("utf-8")).body
        if isinstance(node, ast.FunctionDef) and node.name == name
    )
    return {each.arg for each in (*node.args.args, *node.args.kwonlyargs)}


def listed() -> list[list[list[str]]]:
    """Rows of the table in the glossary, a list of codes a cell."""
    section = (ROOT / "docs" / "glossary.md").read_text("utf-8").split("## Command line and Python")
    rows = [line.split("|")[1:-1] for line in section[1].splitlines() if line.startswith("|")]
    return [[re.findall(r"`([^`]+)`", cell) for cell in row] for row in rows[2:]]


@pytest.mark.parametrize("row", listed(), ids=lambda row: row[0][0] + row[1][0])
def test_what_the_glossary_lists_exists(row: list[list[str]]) -> None:
    commands, names, functions, (parameter,) = row
    assert functions == [FUNCTIONS[command] for command in commands]
    for command, function in zip(commands, functions, strict=True):
        assert {name[2:] for name in names} <= options(command)
        assert parameter in parameters(function)


@pytest.mark.parametrize("command", ["diagnose", "data open-loop", "data import"])
def test_all_others_are_called_alike(command: str) -> None:
    differing = {name[2:] for row in listed() if command in row[0] for name in row[1]}
    same = {name.replace("-", "_") for name in options(command) - differing - FILES}
    functions = (FUNCTIONS[name] for name in FUNCTIONS if name.partition(" --")[0] == command)
    known = set[str]().union(*map(parameters, functions))
    assert same <= known, "list it in the glossary, or rename one"
