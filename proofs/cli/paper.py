"""``python -m proofs paper``: published results beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ventbench.base import files
from ventbench.cli.options import JsonFile, RecordingsDir, Workers, bar, told


def paper(
    recordings: RecordingsDir = None,
    full: Annotated[
        bool,
        typer.Option(
            "--full",
            help="Also run the studies again: learning curves, parts of the controller, and with "
            "--recordings the shapes of networks. Hours on 2 cores; the same command continues.",
        ),
    ] = False,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder in which --full keeps finished trainings.")
    ] = Path("runs/paper"),
    seeds: Annotated[
        int, typer.Option(min=1, max=32, help="Trainings of each method and part with --full.")
    ] = 5,
    workers: Workers = 0,
    page: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write the page, with charts.")
    ] = None,
    markdown: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the page as Markdown."),
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write what took minutes, in the form of proofs/paper/stored.json."
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Set each table and figure of the paper that needs no hardware beside ours.

    The grid of PIDs and the bundled entries run on the frozen simulators; what takes minutes is
    read from stored results, unless --full or --recordings measures it again.

    Example: `python -m proofs paper --html paper.html --json paper.json`
    """
    from rich.table import Table

    from proofs.paper.paper import reproduce_paper

    with bar("paper") as progress:
        result, stored = reproduce_paper(
            recordings=recordings, full=full, out=out, seeds=seeds,
            workers=workers,
            progress=lambda what, share: progress(share, text=what),
        )  # fmt: skip
    console = told(result.to_json(), json)
    summary = result.summary()
    for part in (summary, *(table for section in result.sections for table in section.tables)):
        table = Table(title=part.caption, show_lines=part is summary)
        for k, name in enumerate(part.columns):
            table.add_column(name, justify="left" if k == 0 or part is summary else "right")
        for row in part.texts():
            table.add_row(*row)
        console.print(table)
    for place, what, why in result.not_reproduced:
        console.print(f"not reproduced: {place}: {what}; {why}")
    written = []
    if page is not None:
        from proofs.paper.page import write_reproduction

        written.append(write_reproduction(page, result))
    if markdown is not None:
        files.write_text(markdown, result.to_markdown())
        written.append(markdown)
    if store is not None:
        files.write_json(store, stored)
        written.append(store)
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True)
