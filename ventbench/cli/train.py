"""``ventbench train residual``: a network that corrects a PID."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.cli.options import JsonFile, emit


def residual(
    lung: Annotated[
        str | None, typer.Option(metavar="ID", help="Only a network for this lung, such as R20C50.")
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Only one network for all six, not told which.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of weights and benches.")] = 0,
    updates: Annotated[
        int | None, typer.Option(min=1, help="Updates of a network; those of the docs if left.")
    ] = None,
    members: Annotated[
        int, typer.Option(min=1, max=5, help="Simulators a lung: 1 the official one, 5 all.")
    ] = 5,
    randomise: Annotated[
        float, typer.Option(min=0.0, max=4.0, help="Deviations of the bench; 1: as the draws'.")
    ] = 1.0,
    agreement: Annotated[
        float | None, typer.Option(min=0.0, help="Weight of what the simulators disagree about.")
    ] = None,
    penalty: Annotated[
        float, typer.Option("--lambda", min=0.0, help="Weight of the correction, cmH2O for each %.")
    ] = 0.0,
    round_robin: Annotated[
        bool, typer.Option("--round-robin", help="One lung at one PIP an update, in turn.")
    ] = False,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write.")] = Path(
        "runs/residual"
    ),
    json: JsonFile = None,
) -> None:
    """Learn a correction of the best PID by differentiating through the frozen simulators.

    Writes weights.npz, as `submissions/residual_mlp` and `submissions/residual_mlp_all` read it,
    and training.json. Six networks, one a lung, if neither `--lung` nor `--all` is given. Ctrl-C
    keeps what is done; the same command goes on from there.

    Example: `ventbench train residual --all --out runs/residual_all`
    """
    from rich.console import Console

    from ventbench.errors import InputError
    from ventbench.lungs import LUNG_IDS, scored_lung
    from ventbench.training.residual import ResidualConfig
    from ventbench.training.trained import ALL

    if lung is not None and every:
        raise InputError("give --lung ID or --all, not both")
    names = (ALL,) if every else LUNG_IDS if lung is None else (scored_lung(lung).id,)
    standard = ResidualConfig()
    config = ResidualConfig(
        updates=updates or standard.updates,
        members=members,
        spread=randomise,
        agreement=standard.agreement if agreement is None else agreement,
        lam=penalty,
        round_robin=round_robin,
    )
    result = _train(names, out, config, seed)
    emit(result, json)
    console = Console(stderr=str(json) == "-")
    console.print(_table(result))
    console.print(f"wrote {out}", markup=False, highlight=False, soft_wrap=True)


def _train(names: tuple[str, ...], out: Path, config: Any, seed: int) -> dict[str, Any]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from ventbench.training.residual import train_residual

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def report(what: str, progress: Any) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=None)
            if progress is not None:
                done, total, loss = progress
                text = f"{what}: {loss:.3f} cmH2O"
                bars.update(tasks[what], description=text, completed=done, total=total)

        trained = train_residual(names, out, config=config, seed=seed, progress=report)
    return trained.report


def _table(result: dict[str, Any]) -> Any:
    from rich.table import Table

    table = Table(title="Nominal mean |pressure - target|, cmH2O")
    for name in ("network", "lung", "PID", "corrected", "change"):
        table.add_column(name, justify="left" if name in ("network", "lung") else "right")
    for network, figures in result["networks"].items():
        for lung, error in figures["error"].items():
            before = figures["error_pid"][lung]
            change = f"{100 * (error / before - 1):+.1f} %"
            table.add_row(network, lung, f"{before:.3f}", f"{error:.3f}", change)
    return table


def register(train: typer.Typer) -> None:
    """Add the command to the group ``train``."""
    train.command()(residual)
