"""``ventbench data``: recordings on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ventbench.cli.options import Clip, JsonFile, Pad, emit

app = typer.Typer(name="data", help="Check recordings.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    pass


@app.command()
def check(
    file: Annotated[Path, typer.Argument(help="CSV, CSV.GZ or Parquet in the public schema.")],
    clip: Clip = False,
    pad: Pad = False,
    json: JsonFile = None,
) -> None:
    """Say everything that is wrong with a recording, with line, column and value.

    Example: `ventbench data check lab.csv`
    """
    from rich.console import Console

    from ventbench import recordings

    console = Console(stderr=True)
    with console.status(f"reading {file}"):
        report = recordings.check(file, clip=clip, pad=pad)
    emit(report.to_dict(), json)
    for line in report.lines():
        typer.echo(line, err=str(json) == "-")
    if not report.ok:
        raise typer.Exit(2)
