"""``ventbench score``: a submission through the protocol."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ventbench.cli.options import JsonFile, emit

if TYPE_CHECKING:
    from rich.table import Table

    from ventbench.submissions.result import Score

Track = Literal["performance", "robustness"]


def score(
    submissions: Annotated[
        list[str],
        typer.Argument(metavar="SUBMISSION...", help="Folders, or names of bundled submissions."),
    ],
    track: Annotated[
        Track | None, typer.Option(help="Track to score for; the submission's first by default.")
    ] = None,
    draws: Annotated[
        int, typer.Option(min=0, max=20, help="How many of the 20 published draws to run as well.")
    ] = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Keep score.json and trajectories here.")
    ] = None,
    report: Annotated[
        bool, typer.Option("--report", help="Also write report.html and scores.rrd to DIR.")
    ] = False,
    json: JsonFile = None,
) -> None:
    """Score controllers on the six frozen lung simulators.

    Lower is better: mean |pressure - target| over the inspirations, cmH2O.

    Example: `ventbench score submissions/pid_best --json score.json`
    """
    from rich.console import Console

    from ventbench.errors import InputError
    from ventbench.plants import frozen
    from ventbench.submissions.folder import open_submission
    from ventbench.submissions.scoring import score as run

    if report and out is None:
        raise InputError("--report needs --out DIR to write to")
    opened = [open_submission(name) for name in submissions]
    names = [entry.manifest.name for entry in opened]
    if len(set(names)) < len(names):
        raise InputError(f"two submissions have the same name: {', '.join(sorted(names))}")
    progress = Console(stderr=True)
    simulators = frozen.load()
    results = []
    for submission in opened:
        with progress.status(f"scoring {submission.label}"):
            results.append(
                run(
                    submission,
                    simulators.plants,
                    track=track,
                    draws=draws,
                    simulators=simulators.about(),
                )
            )
    plain = [result.to_json() for result, _ in results]
    emit(plain[0] if len(plain) == 1 else {"submissions": plain}, json)
    console = Console(stderr=str(json) == "-")
    console.print(_table([result for result, _ in results]))
    for result, _ in results:
        for failure in result.failures[:3]:
            progress.print(failure.message, style="red", markup=False)
    if out is not None:
        for path in _keep(out, results, plain, report):
            console.print(f"wrote {path}", markup=False, highlight=False)
    if any(result.failures for result, _ in results):
        raise typer.Exit(1)


def _table(scores: list[Score]) -> Table:
    from rich.table import Table

    from ventbench.lungs import LUNG_IDS

    table = Table(title="Mean |pressure - target| of the inspirations, cmH2O (lower is better)")
    table.add_column("submission")
    table.add_column("track")
    for name in (*LUNG_IDS, "mean"):
        table.add_column(name, justify="right")
    for one in scores:
        cells = [f"{value:.3f}" if value == value else "failed" for value in one.by_lung]
        mean = f"{one.score:.3f}" if one.score == one.score else "failed"
        table.add_row(one.submission.manifest.name, one.track, *cells, mean)
    return table


def _keep(out: Path, results: list[Any], plain: list[Any], report: bool) -> list[Path]:
    from ventbench import files

    written = []
    for (result, trajectories), values in zip(results, plain, strict=True):
        folder = out / result.submission.manifest.name
        files.write_json(folder / "score.json", values)
        trajectories.save(folder / "trajectories.npz")
        written.append(folder)
    if report:
        from ventbench import views

        runs = [trajectories for _, trajectories in results]
        written.append(views.write_report(out / "report.html", runs, plain))
        written.append(views.write_rerun(out / "scores.rrd", runs))
    return written


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(score)
