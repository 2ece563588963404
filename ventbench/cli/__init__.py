"""The command line ``ventbench``: parses, calls, prints. One module per group of commands.

Exit codes: 0 done; 1 the command ran and the answer is no; 2 bad input. Heavy packages are
imported inside the commands, so that ``ventbench --help`` answers at once.
"""

from __future__ import annotations

import sys

import typer

from ventbench import __version__
from ventbench.cli import (
    board,
    challenge,
    data,
    diagnose,
    mechanics,
    proof,
    score,
    simulators,
    study,
    submit,
    train,
    tune,
    view,
)
from ventbench.errors import InputError
from ventbench.text import plain

app = typer.Typer(
    name="ventbench",
    help="A benchmark for the control of mechanical ventilators.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def _version(value: bool) -> None:
    if value:
        print(f"ventbench {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    pass


score.register(app)
submit.register(app)
simulators.register(app)
tune.register(app)
train.register(app)
study.register(app)
view.register(app)
board.register(app)
diagnose.register(app)
challenge.register(app)
mechanics.register(app)
proof.register(app)
app.add_typer(data.app)


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except (InputError, OSError) as error:
        # Messages quote files and records of others, which may hold commands to the terminal.
        lines = [plain(line) for line in str(error).split("\n")]
        print("ventbench:", "\n".join(lines), file=sys.stderr)
        sys.exit(2)
