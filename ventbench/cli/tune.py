"""``ventbench tune`` and ``headroom``: best gains of a PID, and the bounds of any controller."""

from __future__ import annotations

import shutil
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
    known_lungs,
)

#: Cells of the second optimiser: every so many of all.
_EVERY = 31


def headroom(
    out: Annotated[Path, typer.Option(metavar="FILE", help="File of the reference errors.")] = Path(
        "runs/bounds-v2.npz"
    ),
    check: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Check a file instead of making one: its commands must attain its errors, and a "
            "second optimiser must find nothing better.",
        ),
    ] = None,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    json: JsonFile = None,
) -> None:
    """Compute the best attainable error and the best PID of every cell of the development draws.

    Commands are optimised for each cell with everything known; the best PID of a lung is searched
    for without a grid's edge, on the rigs of the training. Takes minutes; the same command
    continues.

    Example: `ventbench headroom --check data/bounds-v2.npz`
    """
    import numpy as np
    from rich.console import Console

    from ventbench.base.executor import executor
    from ventbench.entries import reference as references
    from ventbench.plants.rigs import load_rigs
    from ventbench.task import draws, protocol
    from ventbench.train.best_pid import best_pids

    console = Console(stderr=str(json) == "-")
    rigs = load_rigs()
    drawn = rigs.draws(draws.COUNT)
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    about = references.settings(rigs.about, drawn.about())
    if check is not None:
        computed = references.load(check)
        references.reference_of(rigs.about, drawn.about(), computed)
        result = references.checked(computed, plants, cells, every=_EVERY)
        emit(result, json)
        for key, value in result.items():
            console.print(f"{key}: {value}", highlight=False)
        if not result["sound"]:
            raise typer.Exit(1)
        return
    parts = out.with_suffix(".parts")
    with bars() as progress:
        pids = best_pids(rigs, progress=counted(progress, "best PID of each lung"))
        with executor(workers, scheduler) as pool:
            computed = references.compute(
                plants, cells, pids.gains, about, folder=parts, pool=pool,
                progress=counted(progress, "best attainable"),
            )  # fmt: skip
    sha256 = computed.save(out)
    shutil.rmtree(parts)  # they are in the file now
    summary = {
        "file": str(out), "sha256": sha256, "gains": computed.gains.tolist(),
        "searches": pids.search_gains.tolist(), "search_errors": pids.search_errors.tolist(),
        "searches_agree": pids.agree.tolist(),
        "distance": np.round(computed.attainable - computed.lower, 6).tolist(),
        "attainable": float(computed.attainable.mean()), "lower": float(computed.lower.mean()),
        "pid": float(computed.pid.mean()),
        "largest_gap": float(np.max(computed.attainable - computed.lower)),
    }  # fmt: skip
    emit(summary, json)
    console.print(
        f"wrote {out}\nmean over cells, first step left out: best attainable "
        f"{summary['attainable']:.3f} cmH2O (at least {summary['lower']:.3f}), best PID "
        f"{summary['pid']:.3f}\nSHA-256 {sha256}",
        highlight=False,
        soft_wrap=True,
    )


app = typer.Typer(name="tune", help="Search for the gains of a controller.", no_args_is_help=True)

PLOT = "grid.png"


@app.callback()
def _group() -> None:
    pass


@app.command()
def pid(
    lung: Annotated[
        str | None,
        typer.Option(
            metavar="LUNG", help="Only this lung, such as R20C50.", autocompletion=known_lungs
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
    beyond: Annotated[
        bool,
        typer.Option("--beyond", help="Search on draws without the grid: gains have no edge."),
    ] = False,
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
    from ventbench.base.files import write_json
    from ventbench.train.best_pid import tune_beyond
    from ventbench.train.pid_grid import RESULT, TABLE, tune_pid

    if (lung is not None) + every + robust != 1:
        raise InputError("give exactly one of --lung LUNG, --all and --robust")
    names = None if lung is None else (lung,)
    with bars() as shown:
        if beyond:
            result = tune_beyond(
                names, draws=draws, each=not robust, single=lung is None, simulator=plant,
                progress=counted(shown, "PIDs"),
            )  # fmt: skip
            write_json(out / RESULT, result)
            written = [RESULT]
        else:
            grid, result = tune_pid(
                names, out, draws=draws, workers=workers, scheduler=scheduler, each=not robust,
                simulator=plant, progress=counted(shown, "trajectories"),
            )  # fmt: skip
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
    from ventbench.pages.plots import gain_map_png

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
    app_.command()(headroom)
    app_.add_typer(app)
