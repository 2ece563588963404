"""``ventbench data``: check recordings, or make new ones by exploration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ventbench.cli.options import Clip, JsonFile, Pad, PlantName, emit

#: Breaths that are explored side by side.
_TOGETHER = 60

app = typer.Typer(
    name="data",
    help="Check recordings, or make new ones by exploring simulators.",
    no_args_is_help=True,
)


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
    """Report every problem of a recording, with line, column and value.

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


@app.command()
def explore(
    out: Annotated[Path, typer.Argument(help="CSV, CSV.GZ or Parquet file to write.")],
    lung: Annotated[str, typer.Option(help="Lung setting, such as R20C50.")] = "R20C50",
    plant: PlantName = "frozen",
    breaths: Annotated[
        int, typer.Option(min=1, help="Number of breaths; the PIPs alternate.")
    ] = 60,
    noise: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of the sensor noise, cmH2O.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of disturbances and noise.")] = 0,
) -> None:
    """Record breaths for training: a safe PID with the disturbances of the paper.

    The inspiratory valve closes above min(60, PIP + 15) cmH2O. Above 60 cmH2O the expiratory valve
    opens, and the exploration stops after three such breaths.

    Example: `ventbench data explore explored.csv --lung R5C20 --breaths 120 --noise 0.2`
    """
    from ventbench import recordings
    from ventbench.plants.catalog import load_simulators
    from ventbench.training import exploration

    chosen = load_simulators(plant).plant(lung)
    ventilator = exploration.SimulatedVentilator(
        chosen, min(breaths, _TOGETHER), noise=noise, seed=seed
    )
    made = exploration.explore(ventilator, lung, breaths, seed=seed)
    recordings.write(made, out)
    for note in made.notes:
        typer.echo(f"note: {note}", err=True)
    highest = float(made.pressure[made.valid].max())
    typer.echo(f"wrote {len(made)} breaths of {lung} to {out}; highest {highest:.1f} cmH2O")
