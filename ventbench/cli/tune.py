"""``ventbench tune``: exhaustive search for the gains of a PID."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.cli.options import (
    JsonFile,
    PlantName,
    Scheduler,
    Workers,
    bars,
    claim_out,
    counted,
    emit,
)

app = typer.Typer(name="tune", help="Search for the gains of a controller.", no_args_is_help=True)

PLOT = "grid.png"


@app.callback()
def _group() -> None:
    pass


@app.command()
def pid(
    lung: Annotated[
        str | None, typer.Option(metavar="LUNG", help="Only this lung, such as R20C50.")
    ] = None,
    every: Annotated[
        bool,
        typer.Option(
            "--all", help="All six lungs: the best gains of each, and the best single set."
        ),
    ] = False,
    robust: Annotated[
        bool, typer.Option("--robust", help="All six lungs: only the best single set.")
    ] = False,
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", callback=claim_out, help="Folder for table, plot and result."),
    ] = Path("runs/pid"),
    workers: Workers = 0,
    scheduler: Scheduler = None,
    plant: PlantName = "frozen",
    draws: Annotated[
        int,
        typer.Option(
            min=0,
            max=20,
            help="Draws with noise and deviations that decide among the 100 best; 0 to decide "
            "without noise, as in the paper.",
        ),
    ] = 20,
    json: JsonFile = None,
) -> None:
    """Simulate the paper's 8,000 PIDs at six PIPs on the frozen simulators or others.

    P, I and D each take the values 0, 0.1, ..., 0.9, 1, 2, ..., 10 %/cmH2O. On the frozen
    simulators a lung has all its rigs but the held-out one. The 100 best without noise also run on
    draws that are for tuning alone, and the best there win. Ctrl-C keeps the finished parts; the
    same command continues.

    Example: `ventbench tune pid --all --out runs/pid`
    """
    from rich.console import Console

    from ventbench.base.errors import InputError
    from ventbench.train.pid_grid import RESULT, TABLE, tune_pid

    if (lung is not None) + every + robust != 1:
        raise InputError("give exactly one of --lung LUNG, --all and --robust")
    with bars() as shown:
        grid, result = tune_pid(
            None if lung is None else (lung,),
            out,
            draws=draws,
            workers=workers,
            scheduler=scheduler,
            each=not robust,
            simulator=plant,
            progress=counted(shown, "trajectories"),
        )
    written = [TABLE, RESULT, *_plot(out / PLOT, grid, not robust, lung is None)]
    emit(result, json)
    console = Console(stderr=str(json) == "-")
    console.print(_table(result))
    for name in written:
        console.print(f"wrote {out / name}", markup=False, highlight=False, soft_wrap=True)


def _plot(path: Path, grid: Any, each: bool, single: bool) -> list[str]:
    """Draw the picture if matplotlib is installed."""
    from ventbench.base import files
    from ventbench.base.errors import InputError
    from ventbench.pages.gain_map import gain_map_png

    try:
        picture = gain_map_png(grid, each=each, single=single)
    except InputError as error:
        typer.echo(f"no plot: {error}", err=True)
        return []
    files.write_atomically(path, lambda file: file.write(picture))
    return [path.name]


def _table(result: dict[str, Any]) -> Any:
    from rich.table import Table

    table = Table(title="Best PID gains; mean |pressure - target|, cmH2O")
    for name in ("lung", "P", "I", "D", "error"):
        table.add_column(name, justify="left" if name == "lung" else "right")

    def add(name: str, entry: dict[str, Any], **style: Any) -> None:
        gains = (f"{gain:g}" for gain in entry["gains"])
        table.add_row(name, *gains, f"{entry['error']:.3f}", **style)

    for name, entry in result.get("lungs", {}).items():
        add(name, entry)
    if "single" in result:
        table.add_section()
        add("all six", result["single"], style="bold")
    return table


def register(app_: typer.Typer) -> None:
    """Add the commands."""
    app_.add_typer(app)
