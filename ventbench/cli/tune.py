"""``ventbench tune``: exhaustive search for the gains of a PID."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.cli.options import JsonFile, PlantName, emit

app = typer.Typer(name="tune", help="Search for gains.", no_args_is_help=True)

PLOT = "grid.png"


@app.callback()
def _group() -> None:
    pass


@app.command()
def pid(
    lung: Annotated[str | None, typer.Option(metavar="LUNG", help="One lung.")] = None,
    every: Annotated[
        bool,
        typer.Option("--all", help="All six: the best gains of each, and the best single set."),
    ] = False,
    robust: Annotated[
        bool, typer.Option("--robust", help="All six: the best single set alone.")
    ] = False,
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Where table, plot and result are written.")
    ] = Path("runs/pid"),
    workers: Annotated[
        int, typer.Option(min=0, help="Processes; 0 runs in this one, which all cores serve.")
    ] = 0,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler, such as tcp://host:8786.")
    ] = None,
    plant: PlantName = "frozen",
    json: JsonFile = None,
) -> None:
    """Run the paper's 8,000 PIDs at six PIPs on the frozen simulators or others.

    P, I and D each 0, 0.1, ..., 0.9, 1, 2, ..., 10 %/cmH2O, without noise. Ctrl-C keeps what is
    finished; the same command goes on from there.

    Example: `ventbench tune pid --all --out runs/pid`
    """
    from rich.console import Console

    from ventbench.errors import InputError
    from ventbench.lungs import LUNG_IDS, scored_lung
    from ventbench.training.pid_grid import RESULT, TABLE

    if (lung is not None) + every + robust != 1:
        raise InputError("say for which lungs: --lung LUNG, --all or --robust, one of them")
    names = (scored_lung(lung).id,) if lung is not None else LUNG_IDS
    grid, result = _search(names, plant, out, workers, scheduler, not robust)
    written = [TABLE, RESULT, *_plot(out / PLOT, grid, not robust, lung is None)]
    emit(result, json)
    console = Console(stderr=str(json) == "-")
    console.print(_table(result))
    for name in written:
        console.print(f"wrote {out / name}", markup=False, highlight=False, soft_wrap=True)


def _search(
    names: tuple[str, ...],
    plant: str,
    out: Path,
    workers: int,
    scheduler: str | None,
    each: bool,
) -> tuple[Any, dict[str, Any]]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    from ventbench.training.pid_grid import tune_pid

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    )  # fmt: skip
    with Progress(*columns, transient=True) as bars:
        task = bars.add_task("trajectories", total=None)

        def progress(done: int, total: int) -> None:
            bars.update(task, completed=done, total=total)

        return tune_pid(
            names,
            out,
            workers=workers,
            scheduler=scheduler,
            each=each,
            simulator=plant,
            progress=progress,
        )


def _plot(path: Path, grid: Any, each: bool, single: bool) -> list[str]:
    """Draw the picture, where matplotlib is there to draw it."""
    from ventbench import files
    from ventbench.errors import InputError
    from ventbench.views import gain_map

    try:
        picture = gain_map.png(grid, each=each, single=single)
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
