"""``ventbench stressors`` and ``adversary``: missing physics, and how little of it is too much."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ventbench.cli.options import (
    JsonFile,
    PlantName,
    claim_out,
    emit,
    known_entries,
    known_lungs,
    waiting,
)


def stressors(json: JsonFile = None) -> None:
    """List the stressors, which are missing physics, and their strengths.

    Example: `ventbench stressors`
    """
    import dataclasses

    from rich.console import Console
    from rich.table import Table

    from ventbench.task.stressors import PAIRS, STRESSORS, VERSION

    lines = [dataclasses.asdict(line) for line in STRESSORS]
    emit({"version": VERSION, "stressors": lines, "pairs": [list(pair) for pair in PAIRS]}, json)
    table = Table(title=f"Stressors, version {VERSION}")
    for name in ("category", "stressor", "what happens", "changes", "mild", "strong"):
        table.add_column(name, justify="right" if name in ("mild", "strong") else "left")
    for line in STRESSORS:
        strengths = (f"{value:.3g}" for value in (line.mild, line.strong))
        how = {"add": "", "scale": " (factor)", "label": " (label)"}[line.rule]
        table.add_row(line.category, line.name, line.title, line.strength + how, *strengths)
    console = Console(stderr=str(json) == "-")
    console.print(table)
    console.print("Pairs, both mild: " + ", ".join(" + ".join(pair) for pair in PAIRS))


def adversary(
    name: Annotated[
        str,
        typer.Argument(
            metavar="SUBMISSION",
            help="Folder or name of a bundled submission.",
            autocompletion=known_entries,
        ),
    ],
    lung: Annotated[
        list[str] | None,
        typer.Option(
            help="Lung to search on; may be repeated. Default: all.", autocompletion=known_lungs
        ),
    ] = None,
    stressor: Annotated[
        list[str] | None,
        typer.Option(help="Stressor that may act; may be repeated. Default: all, and the rig."),
    ] = None,
    track: Annotated[
        Literal["performance", "robustness"] | None,
        typer.Option(help="What the controller is told; default: the first of the submission."),
    ] = None,
    plant: PlantName = "frozen",
    in_process: Annotated[
        bool,
        typer.Option("--in-process", help="Run without the sandbox; only for code that you trust."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", callback=claim_out, help="Write adversary.json and adversary.txt here."
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Search for the mildest plausible physics that makes a controller unsafe.

    Severity 0 is the rig in the middle of the population, 1 the end of the range: a stressor at its
    strong strength, or a rig three standard deviations away; what acts together adds as squares.
    The exit code is 1 if something unsafe was found.

    Example: `ventbench adversary pid_robust --lung R5C10`
    """
    from dataclasses import asdict

    from ventbench.base import compilation, files
    from ventbench.entries.adversary import adversary as search

    compilation.keep()
    with waiting(f"searching for what makes {name} unsafe"):
        found = search(
            name,
            simulator=plant,
            track=track,
            lungs=lung or (),
            stressors=stressor or (),
            sandbox=not in_process,
        )
    values = {"submission": name, "lungs": [asdict(one) for one in found]}
    text = "\n".join(line for one in found for line in one.lines())
    emit(values, json)
    typer.echo(text, err=str(json) == "-")
    if out is not None:
        files.write_json(out / "adversary.json", values)
        files.write_text(out / "adversary.txt", text + "\n")
    if any(one.severity is not None for one in found):
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(stressors)
    app.command()(adversary)
