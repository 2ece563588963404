"""``ventbench train ppo`` and ``ventbench train dqn``; registers ``ventbench study`` too."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.cli import ablation
from ventbench.cli.options import JsonFile, emit
from ventbench.cli.study import bars, study

Lung = Annotated[
    str | None, typer.Option(metavar="ID", help="Only a network for this lung, such as R20C50.")
]
All = Annotated[bool, typer.Option("--all", help="Only one network for all six, not told which.")]
Seed = Annotated[int, typer.Option(min=0, help="Of the first training.")]
Seeds = Annotated[
    int, typer.Option(min=1, max=32, help="Trainings of each network, of which the best is kept.")
]
Steps = Annotated[
    int | None, typer.Option(min=1, help="Control steps of experience; those of the docs if left.")
]


def ppo(
    lung: Lung = None,
    all_lungs: All = False,
    seed: Seed = 0,
    seeds: Seeds = 2,
    steps: Steps = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write.")] = Path("runs/ppo"),
    json: JsonFile = None,
) -> None:
    """Learn a correction of the PID by PPO on the six frozen simulators.

    Writes weights.npz, as `submissions/ppo` reads it, and training.json. Seven networks if neither
    `--lung` nor `--all` is given: one a lung, and one for all six. Ctrl-C keeps what is done; the
    same command goes on from there.

    Example: `ventbench train ppo --lung R20C50 --out runs/ppo-R20C50`
    """
    _train("ppo", lung, all_lungs, seed, seeds, steps, out, json)


def dqn(
    lung: Lung = None,
    all_lungs: All = False,
    seed: Seed = 0,
    seeds: Seeds = 2,
    steps: Steps = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write.")] = Path("runs/dqn"),
    json: JsonFile = None,
) -> None:
    """Learn which of 19 corrections of the PID is best by DQN on the six frozen simulators.

    Writes weights.npz, as `submissions/dqn` reads it, and training.json. Options as of `train ppo`.

    Example: `ventbench train dqn --lung R20C50 --out runs/dqn-R20C50`
    """
    _train("dqn", lung, all_lungs, seed, seeds, steps, out, json)


def _train(
    method: str,
    lung: str | None,
    all_lungs: bool,
    seed: int,
    seeds: int,
    steps: int | None,
    out: Path,
    json: Path | None,
) -> None:
    from rich.console import Console

    from ventbench.errors import InputError
    from ventbench.lungs import scored_lung
    from ventbench.training.rl.train import train_dqn, train_ppo
    from ventbench.training.trained import ALL, NETWORKS

    if lung is not None and all_lungs:
        raise InputError("--lung and --all exclude each other; give one, or none for all seven")
    networks = (ALL,) if all_lungs else NETWORKS if lung is None else (scored_lung(lung).id,)
    train = {"ppo": train_ppo, "dqn": train_dqn}[method]
    with bars() as shown:
        tasks: dict[str, Any] = {}

        def progress(label: str, share: float, best: float) -> None:
            if label not in tasks:
                tasks[label] = shown.add_task(label, total=1.0)
            said = f"{method}, {label}: {best:.3f} cmH2O"
            shown.update(tasks[label], completed=share, description=said)

        trained = train(
            networks, out, seeds=range(seed, seed + seeds), steps=steps, progress=progress
        )
    emit(trained.report, json)
    console = Console(stderr=str(json) == "-")
    console.print(_trained(trained.report))
    console.print(f"wrote {out}", markup=False, highlight=False)


def _trained(about: dict[str, Any]) -> Any:
    from rich.table import Table

    title = f"{about['method']}: mean |pressure - target|, cmH2O"
    table = Table(title=title, caption="Fresh cells: with noise, drawn as the published ones are.")
    for name in ("network", "breaths", "the PID", "at the end", "fresh cells", "best seed"):
        table.add_column(name, justify="left" if name == "network" else "right")
    for name, network in about["networks"].items():
        ends, fresh = (_values(network[key]) for key in ("error_nominal_at_end", "error_fresh"))
        breaths, pid = str(network["breaths"]), f"{network['error_pid']:.3f}"
        table.add_row(name, breaths, pid, ends, fresh, str(network["seed"]))
    return table


def _values(values: list[float]) -> str:
    return " ".join(f"{value:.3f}" for value in values)


def register(app: typer.Typer, train: typer.Typer) -> None:
    """Add the commands to the program and to its group ``train``."""
    train.command()(ppo)
    train.command()(dqn)
    ablation.register(study)
    app.add_typer(study)
