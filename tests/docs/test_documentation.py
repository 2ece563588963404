"""README and docs: Python blocks run, commands parse, links lead somewhere."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from _pytest.mark.structures import ParameterSet

from ci import generated_tables
from proofs import __main__ as proofs
from ventbench.cli import app
from ventbench.task.interfaces import Observation, Task

ROOT = Path(__file__).parents[2]
PROOFS = "python -m proofs"
PROGRAMS = {"ventbench": app, PROOFS: proofs.app}
PAGES = sorted(
    page
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("submissions/*.md"))
    if page.name != "LICENSE.md"
)

#: What makes a block take seconds to minutes on a machine that has compiled nothing yet.
SLOW = re.compile(r"diagnose\(|train_|\bfit\(|ventbench\.score\(")


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)


def python_pages() -> list[ParameterSet]:
    """Return each page with Python blocks; pages with long fits are slow."""
    pages = []
    for page in PAGES:
        found = blocks(page, "python")
        if found:
            slow = SLOW.search("\n".join(found))
            name = str(page.relative_to(ROOT))
            marks = [pytest.mark.slow] if slow else []
            pages.append(pytest.param(page, id=name, marks=marks))
    return pages


def commands(page: Path) -> Iterator[str]:
    """Yield the command lines of a page that call ventbench or proofs, continuations joined."""
    for block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            for part in line.split("&&"):
                if part.strip().startswith(("ventbench ", f"{PROOFS} ")):
                    yield part.strip()


def parse(line: str) -> str:
    """Return why a command line is wrong, or nothing; like the program, without running it."""
    program = PROOFS if line.startswith(PROOFS) else "ventbench"
    words = shlex.split(line.removeprefix(program), comments=True)
    command: Any = typer.main.get_command(PROGRAMS[program])
    path = [program]
    while hasattr(command, "commands"):
        if not words or words[0] not in command.commands:
            return f"`{' '.join(path)}` has no command {words[:1]}"
        command = command.commands[words[0]]
        path.append(words.pop(0))
    context = command.context_class(command, info_name=path[-1])
    try:
        command.make_parser(context).parse_args(args=words)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


@pytest.mark.parametrize("page", python_pages())
def test_python_blocks_run(page: Path, tmp_path: Path) -> None:
    """All blocks of a page, in order, in one fresh interpreter and an empty folder."""
    for name in ("data", "submissions", "leaderboard"):
        (tmp_path / name).symlink_to(ROOT / name)
    script = tmp_path / "blocks.py"
    script.write_text("\n\n".join(blocks(page, "python")), "utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_parse(page: Path) -> None:
    """Every command exists and takes the options that the page gives it."""
    problems = {line: problem for line in commands(page) if (problem := parse(line))}
    assert not problems


def test_the_sites_table_of_commands_has_all_and_their_examples_parse() -> None:
    rows = [line.strip("| ").split(" | ") for line in generated_tables.commands().splitlines()[2:]]
    named = {row[0].strip("`") for row in rows}
    assert {"ventbench score", "ventbench board withdraw", f"{PROOFS} challenge reveal"} <= named
    examples = [part.strip("` ") for row in rows for part in row[2].split("&&")]
    ours = [line for line in examples if line.startswith(("ventbench ", f"{PROOFS} "))]
    assert len(ours) > 30
    assert not {line: problem for line in ours if (problem := parse(line))}


def test_the_page_of_submissions_names_all_that_a_controller_sees() -> None:
    text = (ROOT / "submissions" / "README.md").read_text("utf-8")
    for field in (*Task._fields, *Observation._fields):
        assert f"- `{field}`:" in text


def test_a_resistance_has_one_unit() -> None:
    """R is in cmH2O/(L/s) everywhere; "cmH2O s/L" is the same and looks like another."""
    other = re.compile(r"cmH2O ?[*·]? ?s ?/ ?L\b")
    assert other.search("R in cmH2O s/L")
    pages = [*PAGES, *ROOT.glob("*/README.md"), *ROOT.glob("ventbench/cli/*.py")]
    assert not [page.name for page in pages if other.search(page.read_text("utf-8"))]


def test_wrong_commands_do_not_parse() -> None:
    """The check above can fail."""
    assert "no_such_option" in parse("ventbench score mine --no-such-option").replace("-", "_")
    assert "no command" in parse("ventbench board no-such-command")
    assert "no command" in parse("python -m proofs challenge no-such-command")
    assert not parse("ventbench score mine --draws 20")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    """Every relative link names a file of the repository."""
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text("utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
