"""Entry point of ``python -m proofs``, in a checkout."""

from __future__ import annotations

import sys

import typer

from proofs.cli import challenge, paper, real, study
from ventbench.cli import options

app = typer.Typer(
    name="proofs",
    help="Proofs that ventbench does what it says; each runs from a checkout.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


@app.callback()
def _root(
    quiet: bool = typer.Option(
        False, "--quiet", help="No progress and no notes on stderr; also behind any command."
    ),
) -> None:
    options.be_quiet(quiet)


app.add_typer(challenge.app)
app.command()(real.rig)
app.command()(real.pairs)
app.command()(paper.paper)
app.add_typer(study.app)

if __name__ == "__main__":
    options.run(
        lambda: app(options.quiet_first(sys.argv[1:]), prog_name="python -m proofs"), "proofs"
    )
