"""``ventbench train``: simulators of rigs, and gains of PIDs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.cli.options import (
    JsonFile,
    RecordingsDir,
    SimulatorName,
    bar,
    claim_out,
    complete_lungs,
    recordings_folder,
    table_of,
    written_console,
)

app = typer.Typer(
    name="train", help="Learn simulators; search for gains of PIDs.", no_args_is_help=True
)


@app.command()
def simulator(
    recordings: RecordingsDir = None,
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", callback=claim_out, help="Folder for the simulators."),
    ] = Path("runs/simulators"),
    lungs: Annotated[
        str | None,
        typer.Option(
            metavar="ID,ID,...", help="Lungs to list, such as R5C10,R20C50; default: all recorded."
        ),
    ] = None,
    laminar_share: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            help="Part of the labelled resistance that does not depend on the flow: 0.4 as in a "
            "QuickLung, 1 for a linear resistor.",
        ),
    ] = 0.4,
) -> None:
    """Learn simulators from a folder of recordings in the public schema, with any R and C.

    Every CSV or Parquet file in the folder is read. The result is a folder for `--simulator`.
    Ctrl-C keeps the finished work; the same command continues.

    Example: `ventbench train simulator --recordings my-recordings --out runs/my-rig`
    """
    from ventbench.train.rigs.train import RigConfig, train_rigs

    folder = recordings_folder(recordings)
    listed = None if lungs is None else [name.strip() for name in lungs.split(",")]
    with bar("learning") as learning:
        train_rigs(
            folder,
            out,
            lungs=listed,
            config=RigConfig(laminar_share=laminar_share),
            progress=lambda stage, share: learning(share, text=stage),
        )
    typer.echo(f"wrote {out}")


PLOT = "grid.png"


@app.command()
def pid(
    lung: Annotated[
        str | None,
        typer.Option(
            metavar="LUNG", help="Only this lung, such as R20C50.", autocompletion=complete_lungs
        ),
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
    simulator: SimulatorName = "frozen",
    draws: Annotated[
        int,
        typer.Option(
            min=0,
            max=20,
            help="Draws with noise and deviations that decide among the 100 best; 0 to decide "
            "without noise, as in the paper.",
        ),
    ] = 20,
    beyond: Annotated[
        bool,
        typer.Option("--beyond", help="Search on draws without the grid: gains have no edge."),
    ] = False,
    json: JsonFile = None,
) -> None:
    """Simulate the paper's 8,000 PIDs at six PIPs on the frozen simulators or others.

    P, I and D each take the values 0, 0.1, ..., 0.9, 1, 2, ..., 10 %/cmH2O. On the frozen
    simulators a lung has all its rigs but the held-out one. The 100 best without noise also run on
    draws that are for tuning alone, and the best there win.

    Example: `ventbench train pid --all --out runs/pid`
    """
    from ventbench.train.pid_search import RESULT, TABLE, tune_beyond, tune_pid

    if (lung is not None) + every + robust != 1:
        raise InputError("give exactly one of --lung LUNG, --all and --robust")
    names = None if lung is None else (lung,)
    with bar("PIDs") as progress:
        if beyond:
            result = tune_beyond(
                names, draws=draws, each=not robust, simulator=simulator, progress=progress
            )
            files.write_json(out / RESULT, result)
            written = [RESULT]
        else:
            grid, result = tune_pid(
                names, out, draws=draws, each=not robust, simulator=simulator, progress=progress
            )
            written = [TABLE, RESULT, *_plot(out / PLOT, grid, not robust, lung is None)]
    console = written_console(result, json)
    console.print(_gains_table(result))
    for name in written:
        console.print(f"wrote {out / name}", soft_wrap=True)


def _plot(path: Path, grid: Any, by_lung: bool, single: bool) -> list[str]:
    """Draw the picture if matplotlib is installed."""
    from ventbench.pages.report import gain_map_png

    try:
        picture = gain_map_png(grid, each=by_lung, single=single)
    except InputError as error:
        typer.echo(f"no plot: {error}", err=True)
        return []
    files.write_bytes(path, picture)
    return [path.name]


def _gains_table(result: dict[str, Any]) -> Any:
    def row(name: str, entry: dict[str, Any]) -> tuple[str, ...]:
        return name, *(f"{gain:g}" for gain in entry["gains"]), f"{entry['error']:.3f}"

    rows = (row(name, entry) for name, entry in result.get("lungs", {}).items())
    title = "Best PID gains; mean |pressure - target|, cmH2O"
    table = table_of(title, ("lung", "P", "I", "D", "error"), rows)
    if "single" in result:
        table.add_section()
        table.add_row(*row("all six", result["single"]), style="bold")
    return table
