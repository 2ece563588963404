"""``ventbench study controllers`` and ``study networks``: what the parts of a design are worth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.cli.options import JsonFile, RecordingsDir, emit, recordings_folder
from ventbench.cli.study import bars

Only = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Only this variant, beside the base (may be repeated)."),
]


def controllers(
    seeds: Annotated[int, typer.Option(min=1, max=32, help="Trainings of each variant.")] = 3,
    updates: Annotated[int, typer.Option(min=1, help="Updates of each training.")] = 1000,
    only: Only = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write.")] = Path(
        "runs/controllers"
    ),
    json: JsonFile = None,
) -> None:
    """Take the parts of the residual controller away, one at a time.

    One network for all six lungs by each variant with each seed; nominal score, score on the 20
    published draws, exploitation index. Writes runs.csv and summary.csv. Ctrl-C keeps what is done;
    the same command goes on from there.

    Example: `ventbench study controllers --seeds 3 --updates 1000`
    """
    from ventbench.plants import frozen
    from ventbench.training.ablation import controllers as work
    from ventbench.training.residual import ResidualConfig

    config = ResidualConfig(updates=updates)
    known = work.variants(config)
    _check(only, known)
    with bars() as shown:
        task = shown.add_task("controllers", total=1.0)
        runs = work.compare(
            frozen.load(), out, range(seeds), config=config, only=only,
            progress=lambda what, share: shown.update(task, completed=share, description=what),
        )  # fmt: skip
    table = work.summary(runs)
    emit({"updates": updates, "variants": table.to_dict("records")}, json)
    meanings = {name: variant.meaning for name, variant in known.items()}
    rows = [
        (
            str(row["variant"]), meanings[str(row["variant"])],
            *(f"{row[x]:.3f}" for x in work.FIGURES),
            f"{row['nominal_change_low']:+.3f}..{row['nominal_change_high']:+.3f}",
        )
        for row in table.to_dict("records")
    ]  # fmt: skip
    heads = ("variant", "what", *work.FIGURES, "nominal - base")
    _print("Mean |pressure - target|, cmH2O, mean of the seeds", heads, rows, 2, out, json)


def networks(
    recordings: RecordingsDir = None,
    only: Only = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write.")] = Path(
        "runs/networks"
    ),
    json: JsonFile = None,
) -> None:
    """Change windows, width, depth and boundary networks of the paper's simulators, one at a time.

    Trained on the public recordings, five folds; each breath is judged, open loop, by the network
    that has not seen it. Writes breaths.csv and summary.csv. Ctrl-C keeps what is done; the same
    command goes on from there.

    Example: `ventbench study networks --recordings ../shared/recordings`
    """
    from ventbench.training import simulator
    from ventbench.training.ablation import networks as work

    folder = recordings_folder(recordings)
    _check(only, work.variants(simulator.ARCHITECTURE))
    with bars() as shown:
        task = shown.add_task("networks", total=1.0)
        breaths = work.compare(
            folder, out, only=only,
            progress=lambda what, share: shown.update(task, completed=share, description=what),
        )  # fmt: skip
    table = work.summary(breaths)
    emit({"variants": table.to_dict("records")}, json)
    rows = [
        (
            str(row["variant"]), f"{row['mean']:.3f}", f"{row['median']:.3f}",
            f"{row['change']:+.3f}", f"{row['low95']:+.3f}..{row['high95']:+.3f}",
        )
        for row in table.to_dict("records")
    ]  # fmt: skip
    heads = ("variant", "mean", "median", "less base", "95 %, paired by breath")
    _print("Held-out open-loop MAE, cmH2O", heads, rows, 1, out, json)


def _check(only: list[str] | None, known: dict[str, Any]) -> None:
    from ventbench.errors import InputError

    for name in only or ():
        if name not in known:
            raise InputError(f"--only {name}: no such variant; choose {', '.join(known)}")


def _print(
    title: str, heads: tuple[str, ...], rows: list[tuple[str, ...]], left: int, out: Path, json: Any
) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(stderr=str(json) == "-")
    table = Table(title=title)
    for k, head in enumerate(heads):
        table.add_column(head, justify="left" if k < left else "right")
    for row in rows:
        table.add_row(*row)
    console.print(table)
    console.print(f"wrote {out}", markup=False, highlight=False, soft_wrap=True)


def register(study: typer.Typer) -> None:
    """Add the commands to the group ``study``."""
    study.command()(controllers)
    study.command()(networks)
