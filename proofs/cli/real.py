"""``python -m proofs rig`` and ``pairs``: the diagnosis, tested on real recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from proofs.cli import ResultsPage
from ventbench.base import files
from ventbench.base.errors import require
from ventbench.cli.options import (
    JsonFile,
    RecordingsDir,
    bar,
    bars,
    claim_out,
    emit,
    recordings_folder,
    table_of,
    told,
)

if TYPE_CHECKING:
    from proofs.real.rig import Proof


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
    from proofs.results_page import proof_section, write_section
    from ventbench.base import compilation

    require("jinja2", "rerun")
    folder = recordings_folder(recordings)
    compilation.keep()
    with bars() as tell:
        result = prove(
            folder, out, lambda to, diagnosis: diagnosis.save(to), only or (),
            lambda part, what, share: tell(part, share, text=f"{part}: {what}"),
        )  # fmt: skip
    console = told(result.as_dict(), json)
    if page is not None:
        write_section(page, "proof", proof_section(result))
    _show(console, result)
    if not result.met:
        raise typer.Exit(1)


def _show(console: Any, result: Proof) -> None:
    console.print(_table(result))
    for name, reason in result.impossible.items():
        console.print(f"{name}: {reason}")
    for claim in result.claims:
        verdict = "met" if claim.met else "missed"
        console.print(f"{claim.part}: {claim.what}: {verdict} ({claim.value})")


def _table(result: Proof) -> Any:
    rows = []
    for name, part in result.parts.items():
        errors = (f"{part['mae'][k] or float('nan'):.2f}" for k in ("before", "refit", "after"))
        share = part["cut_percent"]
        rows.append((
            name, str(part["held_out"]), *errors, "-" if share is None else f"{share:.0f} %",
            ", ".join(mechanism["name"] for mechanism in part["mechanisms"]) or "-",
            part["slot"]["name"] if part["slot"] else "-",
            ", ".join(misfit["label"] for misfit in part["misfitting_labels"]) or "-",
        ))  # fmt: skip
    heads = ("part", "n", "before", "refit", "after", "cut", "named", "without a name",
             "label misfits")  # fmt: skip
    return table_of("Open-loop MAE on held-out real breaths, cmH2O", heads, rows, left=heads[6:])


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
    from proofs.real import comparisons as work
    from proofs.results_page import pairs_section, write_section
    from ventbench.base import compilation

    folder = recordings_folder(recordings)
    compilation.keep()
    with bar("comparing") as progress:
        answers = work.run(folder, out, sealed=sealed, kinds=kind or (), progress=progress)
    text = work.report(answers)
    files.write_text(out / ("sealed.md" if sealed else "development.md"), text + "\n")
    if page is not None:
        half = "sealed" if sealed else "development"
        write_section(page, f"real pairs {half}", pairs_section(text, half=half))
    emit(work.as_dict(answers), json)
    typer.echo(text, err=str(json) == "-")
