"""The command line ``ventbench``: parses, calls, prints. One module per group of commands.

Exit codes: 0 done; 1 the command ran and the answer is no; 2 bad input; 130 stopped by Ctrl-C.
Heavy packages are imported inside the commands, so that ``ventbench --help`` answers at once.
"""

from __future__ import annotations

import sys

import typer

from ventbench import __version__
from ventbench.cli import (
    board,
    data,
    diagnose,
    doctor,
    options,
    round,
    score,
    simulators,
    train,
    tune,
)

app = typer.Typer(
    name="ventbench",
    help="A benchmark for the control of mechanical ventilators.",
    no_args_is_help=True,
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
    quiet: bool = typer.Option(
        False, "--quiet", help="No progress and no notes on stderr; also behind any command."
    ),
) -> None:
    options.be_quiet(quiet)


for _module in (score, tune, simulators, diagnose):
    for _command in _module.COMMANDS:
        app.command(_command.__name__.replace("_", "-"))(_command)
app.command()(doctor.doctor)
for _module in (tune, train, board, round, data):
    app.add_typer(_module.app)


def main() -> None:
    """Entry point of the console script."""
    options.run(lambda: app(options.quiet_first(sys.argv[1:])), "ventbench")
