"""``python -m proofs paper``: published results beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ventbench.base import files
from ventbench.cli.options import JsonFile, RecordingsDir, Workers, bar, emit


def paper(
    recordings: RecordingsDir = None,
    workers: Workers = 0,
    store: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the stored results, with errors by horizon as measured with --recordings.",
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Set each table and figure of the paper that needs no hardware beside ours, as Markdown.

    The grid of PIDs and the bundled entries run on the frozen simulators; what takes minutes is
    read from stored results. With --recordings the errors by horizon are measured again; `study
    --store` renews the others.

    Example: `python -m proofs paper --json paper.json`
    """
    from proofs.paper.paper import reproduce_paper

    with bar("paper") as progress:
        result, stored = reproduce_paper(
            recordings=recordings, workers=workers,
            progress=lambda what, share: progress(share, text=what),
        )  # fmt: skip
    emit(result.to_json(), json)
    typer.echo(result.to_markdown(), err=str(json) == "-")
    if store is not None:
        files.write_json(store, stored)
