"""``ventbench lungs``, ``simulate`` and ``open-loop``: simulators without a controller."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench import protocol
from ventbench.cli.options import Clip, JsonFile, Pad, PlantName, emit


def lungs(json: JsonFile = None) -> None:
    """List the six lungs and the errors of their simulators on held-out recordings.

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
        typer.Option(
            metavar="FILE", help="CSV with u_in in %; optionally u_out (0 or 1) and time_step in s."
        ),
    ],
    start: Annotated[
        float, typer.Option(min=0.0, max=60.0, help="Pressure at the first sample, cmH2O.")
    ] = protocol.PEEP,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the CSV to this file instead of stdout."),
    ] = None,
    plant: PlantName = "frozen",
) -> None:
    """Simulate the pressures for a file of valve commands, as CSV.

    Example: `ventbench simulate --lung R20C50 --controls commands.csv`
    """
    from ventbench import files
    from ventbench.simulation import simulate as work

    text = work(controls, lung=lung, simulator=plant, start=start).to_csv()
    if out is None:
        typer.echo(text, nl=False)
    else:
        files.write_text(out, text)


def open_loop(
    recordings: Annotated[
        Path, typer.Argument(help="CSV, CSV.GZ or Parquet file in the public schema.")
    ],
    plant: PlantName = "frozen",
    clip: Clip = False,
    pad: Pad = False,
    json: JsonFile = None,
) -> None:
    """Measure the error of simulators on recorded breaths under the recorded commands.

    The error of a breath is the mean |simulated - recorded| pressure over its inspiratory samples,
    cmH2O; the simulation starts at the first recorded pressure. For held-out errors, a member of
    the ensemble that was not trained on a breath simulates it. Breaths that another lung or valve
    gain explains far better than their label are listed as misfits; only the last column leaves
    them out.

    Example: `ventbench open-loop recording.csv --json errors.json`
    """
    from rich.console import Console

    from ventbench import open_loop_report
    from ventbench import recordings as files

    progress = Console(stderr=True)
    with progress.status(f"reading {recordings}"):
        breaths = files.load(recordings, clip=clip, pad=pad)
    for note in breaths.notes:
        progress.print(f"note: {note}", markup=False, highlight=False)
    with progress.status(f"simulating {len(breaths)} breaths"):
        result = open_loop_report.open_loop(breaths, plant)
    emit(result.as_dict(), json)
    console = Console(stderr=str(json) == "-")
    console.print(_open_loop_table(result.as_dict()))
    for line in result.misfit_lines():
        console.print(line, markup=False, highlight=False)


def _open_loop_table(result: dict[str, Any]) -> Any:
    from rich.table import Table

    table = Table(title=f"Open-loop MAE of the {result['plant']} simulators, cmH2O")
    table.add_column("lung")
    for name in ("n", "mean", "median", "held-out", "95 %", "median", "no misfits"):
        table.add_column(name, justify="right", no_wrap=True)

    def show(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    for lung, figures in result["lungs"].items():
        low, high = figures["held_out_ci95"]
        apart = figures["fitting_label"]
        table.add_row(
            lung,
            str(figures["breaths"]),
            show(figures["mae"]),
            show(figures["median_mae"]),
            show(figures["held_out_mae"]),
            f"{show(low)}..{show(high)}",
            show(figures["held_out_median_mae"]),
            f"{show(apart['held_out_mae'])} ({apart['held_out_breaths']})",
        )
    return table


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(lungs)
    app.command()(simulate)
    app.command("open-loop")(open_loop)
