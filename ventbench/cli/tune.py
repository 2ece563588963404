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
    version: Annotated[
        int,
        typer.Option(
            "--protocol",
            min=1,
            max=2,
            help="Version of the protocol; 2: on all rigs of each lung but the held-out one, the "
            "best also with noise; only with --all.",
        ),
    ] = 1,
    json: JsonFile = None,
) -> None:
    """Simulate the paper's 8,000 PIDs at six PIPs on the frozen simulators or others.

    P, I and D each take the values 0, 0.1, ..., 0.9, 1, 2, ..., 10 %/cmH2O; there is no noise.
    Ctrl-C keeps the finished parts; the same command continues. With --protocol 2 the 100 best also
    run on draws of their own, and the best there win.

    Example: `ventbench tune pid --all --out runs/pid`
    """
    from rich.console import Console

    from ventbench.errors import InputError
    from ventbench.training.pid_grid import RESULT, TABLE

    if (lung is not None) + every + robust != 1:
        raise InputError("give exactly one of --lung LUNG, --all and --robust")
    if version == 2:
        if not every:
            raise InputError("--protocol 2 tunes all lungs: give --all")
        grid, result = _search_rigs(plant, out, workers, scheduler)
    else:
        names = None if lung is None else (lung,)
        grid, result = _search(names, plant, out, workers, scheduler, not robust)
    written = [TABLE, RESULT, *_plot(out / PLOT, grid, not robust, lung is None)]
    emit(result, json)
    console = Console(stderr=str(json) == "-")
    console.print(_table(result))
    for name in written:
        console.print(f"wrote {out / name}", markup=False, highlight=False, soft_wrap=True)


def _search(
    names: tuple[str, ...] | None,
    plant: str,
    out: Path,
    workers: int,
    scheduler: str | None,
    each: bool,
) -> tuple[Any, dict[str, Any]]:
    from ventbench.training.pid_grid import tune_pid

    with bars() as shown:
        return tune_pid(
            names,
            out,
            workers=workers,
            scheduler=scheduler,
            each=each,
            simulator=plant,
            progress=counted(shown, "trajectories"),
        )


def _search_rigs(
    plant: str, out: Path, workers: int, scheduler: str | None
) -> tuple[Any, dict[str, Any]]:
    """Tune for protocol version 2, and write the same files."""
    from ventbench import files
    from ventbench.training.pid_grid import RESULT, TABLE
    from ventbench.training.rig_pid import tune_on_rigs

    with bars() as shown:
        progress = counted(shown, "lungs")
        tuned = tune_on_rigs(plant, progress=progress, workers=workers, scheduler=scheduler)
    tuned.nominal.save(out / TABLE)
    result = tuned.to_json()
    files.write_json(out / RESULT, result)
    return tuned.nominal, result


def _plot(path: Path, grid: Any, each: bool, single: bool) -> list[str]:
    """Draw the picture if matplotlib is installed."""
    from ventbench import files
    from ventbench.errors import InputError
    from ventbench.views.gain_map import gain_map_png

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
