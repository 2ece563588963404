"""A job of a workflow: its variables, its summary page, its outputs and its exit code."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from ventbench.base.errors import InputError
from ventbench.base.text import plain


def required(name: str) -> str:
    """Return an environment variable.

    Raises:
        InputError: if it is not set, or empty.
    """
    value = os.environ.get(name, "")
    if not value:
        raise InputError(f"environment variable {name} is not set; the workflow sets it")
    return value


def summary(title: str, lines: Iterable[str]) -> None:
    """Print lines, and put them on the page of the workflow's run where there is one.

    Args:
        title: of ours.
        lines: may quote a submission; they are shown as they are, never as Markdown or HTML, nor
            as a command to the workflow.
    """
    shown = [line for text in lines for line in text.splitlines() or [""]]
    for line in shown:
        print(f"| {plain(line)}")  # a line that begins with `::` would be a command
    target = os.environ.get("GITHUB_STEP_SUMMARY")
    if target:
        with open(target, "a", encoding="utf-8") as file:
            file.write(f"## {title}\n\n{fenced(shown)}\n")


def annotate(title: str, lines: Iterable[str], file: str, *, wrong: bool) -> None:
    """Show lines on the pull request, at the first line of a file, which takes no right to write.

    Args:
        title: of ours.
        lines: may quote a submission; none can end the command that shows them.
        file: path in the repository, of anybody.
        wrong: whether they are objections.
    """
    if os.environ.get("GITHUB_ACTIONS"):
        said = "%0A".join(plain(x).replace("%", "%25") for text in lines for x in text.splitlines())
        place = "".join(f"%{ord(x):02X}" if x in "%:,\r\n" else x for x in file)
        print(f"::{'error' if wrong else 'notice'} file={place},line=1,title={title}::{said}")


def fenced(lines: Iterable[str]) -> str:
    """Markdown that shows lines as they are: each indented, none able to end the block."""
    return "".join(f"    {line}\n" for text in lines for line in text.splitlines() or [""])


def output(**values: str) -> None:
    """Hand values to later steps of the workflow.

    Args:
        values: by name; one line each, of ours.

    Raises:
        ValueError: if one has a line break, with which it could hand on more than itself.
    """
    target = os.environ.get("GITHUB_OUTPUT")
    lines = []
    for name, value in values.items():
        if not value.isprintable():
            raise ValueError(f"output {name} is {value!r}, not one line")
        lines.append(f"{name}={value}\n")
    if target:
        with open(Path(target), "a", encoding="utf-8") as file:
            file.writelines(lines)


def run(title: str, job: Callable[[], int]) -> int:
    """Do a job and return its exit code; what is wrong with its input is said, with exit code 2."""
    try:
        return job()
    except (InputError, OSError) as error:
        summary(title, [f"stopped: {line}" for line in str(error).splitlines()])
        return 2
