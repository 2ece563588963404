"""``ventbench lungs``, ``ventbench simulate``: the simulators by themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ventbench import protocol
from ventbench.cli.options import JsonFile, PlantName, emit


def lungs(json: JsonFile = None) -> None:
    """List the six lungs, and how well their simulators meet held-out recordings.

    Example: `ventbench lungs`
    """
    from rich.console import Console
    from rich.table import Table

    from ventbench.plants import frozen

    table = Table(title="The six lungs of protocol version 1, simulators version 1")
    for name in ("lung", "R cmH2O/(L/s)", "C mL/cmH2O", "held-out MAE cmH2O", "median", "breaths"):
        table.add_column(name, justify="left" if name == "lung" else "right")
    known = frozen.load().lungs()
    emit(known, json)
    for lung_id, about in known.items():
        figures = (about["held_out_mae"], about["held_out_median_mae"])
        table.add_row(
            lung_id,
            f"{about['R']:g}",
            f"{about['C']:g}",
            *(f"{figure:.2f}" for figure in figures),
            str(about["held_out_breaths"]),
        )
    Console(stderr=str(json) == "-").print(table)


def simulate(
    lung: Annotated[str, typer.Option(help="Lung, such as R20C50.")],
    controls: Annotated[
        Path,
        typer.Option(metavar="FILE", help="CSV: u_in in %; optionally u_out and time_step in s."),
    ],
    start: Annotated[
        float, typer.Option(min=0.0, max=60.0, help="Pressure at the first sample, cmH2O.")
    ] = protocol.PEEP,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the CSV here instead of stdout.")
    ] = None,
    plant: PlantName = "frozen",
) -> None:
    """Answer a file of valve commands with pressures, as CSV.

    Example: `ventbench simulate --lung R20C50 --controls commands.csv`
    """
    from ventbench import files
    from ventbench.simulation import simulate as work

    text = work(controls, lung=lung, simulator=plant, start=start).to_csv()
    if out is None:
        typer.echo(text, nl=False)
    else:
        files.write_text(out, text)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(lungs)
    app.command()(simulate)
