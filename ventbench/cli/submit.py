"""``ventbench new`` and ``ventbench check``: on the way to a submission."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ventbench.cli.options import JsonFile, emit

Family = Literal["pid", "residual", "ppo", "dqn", "other"]


def new(
    name: Annotated[
        str,
        typer.Argument(
            help="Lower-case letters, digits and underscores, a letter first; at most 40."
        ),
    ],
    family: Annotated[Family, typer.Option(help="What to start from.")] = "pid",
    folder: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="Folder to write NAME/ into.")
    ] = Path("."),
) -> None:
    """Write a submission that scores at once, to be changed into your own.

    Example: `ventbench new demo && ventbench check demo && ventbench score demo`
    """
    from ventbench.submissions import scaffold

    path = scaffold.create(name, family, folder)
    typer.echo(f"wrote {path}: " + ", ".join(sorted(entry.name for entry in path.iterdir())))
    typer.echo(f"next: ventbench check {path} && ventbench score {path}")


def check(
    submission: Annotated[str, typer.Argument(help="Folder, or name of a bundled submission.")],
    in_process: Annotated[
        bool,
        typer.Option(
            "--in-process", help="Run it in this process, with all rights: only your own."
        ),
    ] = False,
    json: JsonFile = None,
) -> None:
    """Say everything that stands between a submission and the leaderboard.

    Reads its files, manifest and sources, then runs it for a few breaths in the sandbox. Exit code
    0: ready; 1: it has problems; 2: there is nothing to check, or it cannot be run apart here.

    Example: `ventbench check submissions/mine --json check.json`
    """
    from ventbench.submissions import contract
    from ventbench.submissions.runner import InProcessRunner

    report = contract.check(submission, InProcessRunner() if in_process else None)
    emit(report.to_json(), json)
    for line in report.lines():
        typer.echo(line, err=str(json) == "-")
    if not report.ok:
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(new)
    app.command()(check)
