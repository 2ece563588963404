"""``ventbench real-pairs``: known differences between real recordings, hidden from the tool."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ventbench.cli.options import JsonFile, RecordingsDir, ResultsPage, emit


def real_pairs(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the answers.")],
    recordings: RecordingsDir = None,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="Only this kind (may be repeated): label, lung, drive, leak, lag; and, minutes a "
            "pair, leak_driven, lag_driven, lung_pressure, gain_pressure, lag_pressure.",
        ),
    ] = None,
    sealed: Annotated[
        bool,
        typer.Option("--sealed", help="Open the sealed half of the pairs; it can be opened once."),
    ] = False,
    json: JsonFile = None,
    page: ResultsPage = None,
) -> None:
    """Compare real recordings whose difference is known and concealed.

    One lung against another, blower against proportional valve, a leak or a lag added to the
    signals at several strengths, labels of all runs with flow. Prints the rates of right answers
    and the detection curves as Markdown. Half of the pairs are for development; the others are
    sealed. Ctrl-C keeps the finished answers; the same command continues.

    Example: `ventbench real-pairs --recordings recordings --out runs/pairs`
    """
    from ventbench import compilation, files
    from ventbench.cli.options import bars, recordings_folder
    from ventbench.validation import real_pairs as work
    from ventbench.validation.results_page import pairs_section, write_section

    folder = recordings_folder(recordings)
    compilation.keep()
    with bars() as shown:
        task = shown.add_task("comparing", total=None)
        answers = work.run(
            folder, out, sealed=sealed, kinds=kind or (),
            progress=lambda done, total: shown.update(task, completed=done, total=total),
        )  # fmt: skip
    text = work.report(answers)
    files.write_text(out / ("sealed.md" if sealed else "development.md"), text + "\n")
    if page is not None:
        half = "sealed" if sealed else "development"
        write_section(page, f"real pairs {half}", pairs_section(text, half=half))
    emit(work.as_dict(answers), json)
    typer.echo(text, err=str(json) == "-")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("real-pairs")(real_pairs)
