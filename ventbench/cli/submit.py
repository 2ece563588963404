"""``ventbench new`` and ``ventbench check``: write and check submissions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ventbench.cli.options import JsonFile, bars, counted, emit

Family = Literal["pid", "residual", "ppo", "dqn", "other"]


def new(
    name: Annotated[
        str,
        typer.Argument(
            help="At most 40 lower-case letters, digits and underscores, starting with a letter."
        ),
    ],
    family: Annotated[Family, typer.Option(help="Kind of controller to start from.")] = "pid",
    folder: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="Folder in which NAME/ is written.")
    ] = Path("."),
) -> None:
    """Write a submission that can be scored at once; change it into your own.

    Example: `ventbench new demo && ventbench check demo && ventbench score demo`
    """
    from ventbench.submissions import scaffold

    path = scaffold.create(name, family, folder)
    typer.echo(f"wrote {path}: " + ", ".join(sorted(entry.name for entry in path.iterdir())))
    typer.echo(f"next: ventbench check {path} && ventbench score {path}")


def check(
    submission: Annotated[str, typer.Argument(help="Folder or name of a bundled submission.")],
    in_process: Annotated[
        bool,
        typer.Option("--in-process", help="Run without the sandbox; only for code that you trust."),
    ] = False,
    json: JsonFile = None,
) -> None:
    """Report every problem that keeps a submission from the leaderboard.

    Reads its files, manifest and sources, then runs it for a few breaths in the sandbox. The exit
    code is 0 if it is ready, 1 if it has problems, and 2 if there is nothing to check or no sandbox
    to run it in.

    Example: `ventbench check submissions/mine --json check.json`
    """
    from ventbench.submissions import contract
    from ventbench.submissions.runner import InProcessRunner

    with bars() as shown:
        report = contract.check(
            submission,
            InProcessRunner() if in_process else None,
            progress=counted(shown, f"running {submission}"),
        )
    emit(report.to_json(), json)
    for line in report.lines():
        typer.echo(line, err=str(json) == "-")
    if not report.ok:
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(new)
    app.command()(check)
