"""``ventbench study samples``: how many breaths each way of learning needs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.cli.options import JsonFile, emit

study = typer.Typer(name="study", help="Compare ways of learning.", no_args_is_help=True)


def bars() -> Any:
    """Progress bars on stderr: what is done, and the time that is left."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    return Progress(*columns, transient=True, console=Console(stderr=True))


@study.callback()
def _group() -> None:
    pass


@study.command()
def samples(
    lung: Annotated[str, typer.Option(metavar="ID", help="The lung.")] = "R20C50",
    seeds: Annotated[int, typer.Option(min=1, max=32, help="Trainings by each method.")] = 5,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write.")] = Path("runs/study"),
    share: Annotated[
        float, typer.Option(min=0.001, max=1.0, help="Of the full length of each training.")
    ] = 1.0,
    json: JsonFile = None,
) -> None:
    """Compare how many breaths policy gradient, PPO and DQN need for their scores.

    Writes samples.csv (the curves), summary.csv and study-samples.png. Ctrl-C keeps what is done;
    the same command goes on from there. Needs the extra `view` for the picture.

    Example: `ventbench study samples --lung R20C50 --seeds 5`
    """
    from rich.console import Console

    from ventbench import extras, files
    from ventbench.lungs import scored_lung
    from ventbench.training import study as work

    extras.require("matplotlib")
    with bars() as shown:
        tasks: dict[str, Any] = {}

        def progress(method: str, done: float, best: float) -> None:
            if method not in tasks:
                tasks[method] = shown.add_task(method, total=1.0)
            said = f"{method}: {best:.3f} cmH2O"
            shown.update(tasks[method], completed=done, description=said)

        result = work.sample_efficiency(
            scored_lung(lung), range(seeds), out, share=share, progress=progress
        )
    from ventbench.views import learning_curves

    picture = learning_curves.png(result)
    files.write_atomically(out / "study-samples.png", lambda file: file.write(picture))
    table = result.summary()
    emit({"lung": result.lung, "methods": _plain(table)}, json)
    console = Console(stderr=str(json) == "-")
    console.print(_summary(result, table))
    console.print(f"wrote {out}", markup=False, highlight=False)


def _plain(table: Any) -> list[dict[str, Any]]:
    rows = table.to_dict("records")
    # What is not reached is NaN in the table and null in JSON.
    return [{k: None if v != v else v for k, v in row.items()} for row in rows]


def _summary(result: Any, frame: Any) -> Any:
    from rich.table import Table

    caption = (
        f"The PID that is corrected: {result.start:.3f}; best of the grid: {result.best_pid:.3f}."
    )
    table = Table(title=f"{result.lung}: nominal score, cmH2O, and experience", caption=caption)
    # The file has more columns, and longer names for them.
    heads = {
        "method": "method",
        "final": "final",
        "episodes": "breaths",
        "at_100_episodes": "at 100",
        "episodes_to_best_pid": "to best PID",
        "episodes_to_2_percent": "to 2 %",
        "seconds_to_2_percent": "s to 2 %",
    }
    for name, head in heads.items():
        first = name == "method"
        table.add_column(head, justify="left" if first else "right", no_wrap=first)
    for row in _plain(frame):
        table.add_row(*("-" if row[k] is None else str(row[k]) for k in heads))
    return table
