"""``python -m proofs rig`` and ``pairs``: the diagnosis, tested on real recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from proofs.cli import ResultsPage
from ventbench.base.errors import require
from ventbench.cli.options import (
    JsonFile,
    RecordingsDir,
    bar,
    bars,
    claim_out,
    emit,
    recordings_folder,
)


def rig(
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            callback=claim_out,
            help="Folder for the results: a folder for each part, and proof.json.",
        ),
    ],
    recordings: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder with pvp_quicklung.csv; default: VENTBENCH_RECORDINGS.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Only this part (may be repeated): rc, two_balloon, removed, injected, frozen.",
        ),
    ] = None,
    json: JsonFile = None,
    page: ResultsPage = None,
) -> None:
    """Diagnose models of the real rig, with known effects removed or injected.

    The parts are: rc and two_balloon, R-C lungs and the paper's two-balloon lungs at their labels,
    against the recordings of the six lungs; removed, the corrected R-C lungs without their most
    important mechanism, which must be named; frozen, the frozen simulators against the recordings;
    and injected, the frozen simulators against recordings with an added sensor lag of 80 ms, which
    must be named. Takes about half an hour. Ctrl-C keeps the finished parts; the same
    command continues.

    The exit code is 1 if a claim fails.

    Example: `python -m proofs rig --recordings recordings --out runs/proof`
    """
    from proofs.real.rig import prove
    from proofs.results_page import proof_sections, write_section
    from ventbench.base import compilation

    require("jinja2", "rerun")
    folder = recordings_folder(recordings)
    compilation.keep()
    with bars() as tell:
        result = prove(
            folder,
            out,
            only or (),
            lambda part, what, share: tell(part, share, text=f"{part}: {what}"),
        )
    sections = proof_sections(result)
    if page is not None:
        for name, text in sections.items():
            write_section(page, name, text)
    emit(result.as_dict(), json)
    typer.echo("\n\n".join(sections.values()), err=str(json) == "-")
    if not result.met:
        raise typer.Exit(1)


def pairs(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the answers.")],
    recordings: RecordingsDir = None,
    kind: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND",
            help="Only this kind (may be repeated): label, lung, drive, leak, lag.",
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

    Example: `python -m proofs pairs --recordings recordings --out runs/pairs`
    """
    from proofs.real import pairs as work
    from proofs.results_page import pairs_section, write_section
    from ventbench.base import compilation

    folder = recordings_folder(recordings)
    compilation.keep()
    with bar("comparing") as progress:
        answers = work.run(folder, out, sealed=sealed, kinds=kind or (), progress=progress)
    half = "sealed" if sealed else "development"
    text = pairs_section(work.report(answers), half)
    if page is not None:
        write_section(page, f"real pairs {half}", text)
    emit(work.as_dict(answers), json)
    typer.echo(text, err=str(json) == "-")
