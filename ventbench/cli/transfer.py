"""``ventbench transfer``: how entries do away from where they were tuned."""

from __future__ import annotations

from typing import Annotated

import typer

from ventbench.cli.options import JsonFile, bars, counted, emit
from ventbench.cli.score import Track


def transfer(
    names: Annotated[
        list[str],
        typer.Argument(metavar="SUBMISSION...", help="Folders or names of bundled submissions."),
    ],
    track: Annotated[
        Track | None, typer.Option(help="Track to score; default: the first of the submission.")
    ] = None,
    in_process: Annotated[
        bool,
        typer.Option("--in-process", help="Run without the sandbox; only for code that you trust."),
    ] = False,
    json: JsonFile = None,
) -> None:
    """Score controllers on every rig and every member of the ensemble, without noise.

    Columns: the reference rig of each lung, which the nominal score uses; the same rig in the other
    members of the ensemble; the lung's other rigs; the rig on which no entry of ours was trained.

    Example: `ventbench transfer pid_best residual_mlp --json transfer.json`
    """
    from rich.console import Console
    from rich.table import Table

    from ventbench.submissions import rig_scoring
    from ventbench.submissions import transfer as transfers
    from ventbench.submissions.folder import open_submission
    from ventbench.submissions.runner import CountingRunner, InProcessRunner, Runner

    runner: Runner = InProcessRunner()
    if not in_process:
        from ventbench.sandbox.runner import SandboxRunner

        runner = SandboxRunner()
    opened = [open_submission(name) for name in names]
    rigs = rig_scoring.load_rigs()
    results = []
    for entry in opened:
        with bars() as shown:
            counting = CountingRunner(runner, counted(shown, f"running {entry.label}"))
            results.append(transfers.transfer(entry, rigs, track=track, runner=counting))
    emit({"entries": [result.to_json() for result in results]}, json)
    table = Table(title="Mean |pressure - target| on rigs, cmH2O (lower is better)")
    table.add_column("entry")
    for group in transfers.GROUPS:
        plants = int(results[0].plants[group].sum())
        table.add_column(f"{group}\n{plants} plants", justify="right")
    best = {
        group: min((result.mean(group) for result in results), default=0.0)
        for group in transfers.GROUPS
    }
    for result in results:
        cells = []
        for group in transfers.GROUPS:
            value = result.mean(group)
            text = f"{value:.3f}" if value == value else "-"
            cells.append(f"[bold]{text}[/bold]" if value == best[group] else text)
        table.add_row(f"{result.name}, {result.track}", *cells)
    Console(stderr=str(json) == "-").print(table)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(transfer)
