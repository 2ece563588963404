"""``ventbench open-loop`` and ``ventbench train simulator``: simulators against recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.cli.options import (
    Clip,
    JsonFile,
    Pad,
    PlantName,
    RecordingsDir,
    emit,
    recordings_folder,
)

train = typer.Typer(name="train", help="Learn simulators and controllers.", no_args_is_help=True)


def open_loop(
    recordings: Annotated[Path, typer.Argument(help="CSV, CSV.GZ or Parquet, public schema.")],
    plant: PlantName = "frozen",
    clip: Clip = False,
    pad: Pad = False,
    json: JsonFile = None,
) -> None:
    """Measure how far simulators stray from recorded breaths under the same commands.

    Error of a breath: mean |simulated - recorded| over its inspiratory samples, cmH2O, from the
    first recorded pressure. Held out: each breath by a member of the ensemble that has not seen it.
    Breaths that another lung or valve gain explains far better than their label are listed as
    misfits; they stay in all figures but the last column.

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
    console.print(_table(result.as_dict()))
    for line in result.misfit_lines():
        console.print(line, markup=False, highlight=False)


def _table(result: dict[str, Any]) -> Any:
    from rich.table import Table

    table = Table(title=f"Open-loop MAE of the {result['plant']} simulators, cmH2O")
    table.add_column("lung")
    for name in ("n", "mean", "median", "held-out", "95 %", "median", "no misfits"):
        table.add_column(name, justify="right", no_wrap=True)

    def show(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    for lung, one in result["lungs"].items():
        low, high = one["held_out_ci95"]
        apart = one["fitting_label"]
        table.add_row(
            lung,
            str(one["breaths"]),
            show(one["mae"]),
            show(one["median_mae"]),
            show(one["held_out_mae"]),
            f"{show(low)}..{show(high)}",
            show(one["held_out_median_mae"]),
            f"{show(apart['held_out_mae'])} ({apart['held_out_breaths']})",
        )
    return table


@train.callback()
def _group() -> None:
    pass


@train.command()
def simulator(
    recordings: RecordingsDir = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write them.")] = Path(
        "runs/simulators"
    ),
) -> None:
    """Learn the six simulators from the public recordings, as the frozen ones were.

    Ctrl-C keeps what is finished; the same command goes on from there.

    Example: `ventbench train simulator --recordings ../shared/recordings --out runs/simulators`
    """
    from ventbench.training.simulator import train_simulator

    _train(train_simulator, recordings_folder(recordings), out)


def _train(run: Any, folder: Path, out: Path) -> None:
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True) as bars:
        task = bars.add_task("learning", total=1.0)

        def progress(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share)

        run(folder, out, progress=progress)
    typer.echo(f"wrote {out}")


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("open-loop")(open_loop)
    app.add_typer(train)
