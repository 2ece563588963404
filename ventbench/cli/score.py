"""``ventbench score``: score submissions by the protocol."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ventbench.cli.options import (
    JsonFile,
    PlantName,
    Scheduler,
    Workers,
    claim_out,
    emit,
    notes,
    of_each_entry,
)

if TYPE_CHECKING:
    from rich.table import Table

    from ventbench.stress.score import StressScore
    from ventbench.submissions.folder import Submission
    from ventbench.submissions.result import Score

Track = Literal["performance", "robustness", "stress"]


def score(
    names: Annotated[
        list[str],
        typer.Argument(metavar="SUBMISSION...", help="Folders or names of bundled submissions."),
    ],
    track: Annotated[
        Track | None,
        typer.Option(
            help="Track to score; default: the first of the submission. `stress` runs it under "
            "missing physics that it is not told of."
        ),
    ] = None,
    draws: Annotated[
        int,
        typer.Option(
            min=0,
            max=20,
            help="Number of the 20 published draws to run as well; on the stress track, of cells "
            "of each lung under each condition (6 if not given).",
        ),
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            callback=claim_out,
            help="Write score.json and trajectories to a folder for each submission here.",
        ),
    ] = None,
    report: Annotated[
        bool,
        typer.Option(
            "--report",
            help="Also write report.html and scores.rrd (stress track: stress.png) to the folder "
            "of --out.",
        ),
    ] = False,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write a record for `board add` here; needs --draws 20. Records of the robustness "
            "track hold the stress score too.",
        ),
    ] = None,
    plant: PlantName = "frozen",
    protocol: Annotated[
        int,
        typer.Option(
            min=1,
            max=2,
            help="Version of the protocol: 2 scores airway pressure, draws on the rigs of each "
            "lung.",
        ),
    ] = 1,
    stress: Annotated[
        bool,
        typer.Option(
            help="With --protocol 2: also run entries of the robustness track under missing "
            "physics; six draws with --draws 6 or more, else one."
        ),
    ] = True,
    in_process: Annotated[
        bool,
        typer.Option("--in-process", help="Run without the sandbox; only for code that you trust."),
    ] = False,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    json: JsonFile = None,
) -> None:
    """Score controllers on the six frozen lung simulators.

    The score is the mean |pressure - target| over the inspirations, cmH2O; lower is better. With
    `--protocol 2` the normalised score and the score under missing physics stand beside it. Each
    controller runs in sandboxed processes that have no access to the simulators. With another
    `--plant` the lungs are those of that plant, and the score is not official. Several controllers
    are scored in turn, or at the same time with `--workers` or `--scheduler`.

    Example: `ventbench score submissions/pid_best --json score.json`
    """
    from functools import partial

    from rich.console import Console

    from ventbench import extras
    from ventbench.errors import InputError
    from ventbench.plants.catalog import load_simulators
    from ventbench.submissions import scoring
    from ventbench.submissions.folder import open_submission

    if track == "stress":
        from ventbench.cli.stress import score_entries

        return score_entries(
            names, draws, out, report, plant, in_process, json, record, (workers, scheduler)
        )
    if record is not None and draws < 20:
        raise InputError("--record needs all published draws: add --draws 20")
    if report and out is None:
        raise InputError("--report needs --out DIR to write to")
    if report:
        extras.require("jinja2", "rerun")
    opened = [open_submission(name) for name in names]
    entries = [entry.manifest.name for entry in opened]
    if len(set(entries)) < len(entries):
        raise InputError(f"two submissions have the same name: {', '.join(sorted(entries))}")
    if record is not None and plant != "frozen":
        raise InputError("--record needs the official simulators: leave out --plant")
    load_simulators(plant)  # whatever is wrong with it is told before anything runs
    work = partial(
        scoring.score,
        simulator=plant,
        track=track,
        draws=draws,
        sandbox=not in_process,
        protocol=protocol,
    )
    scores = of_each_entry("scoring", work, opened, workers, scheduler)
    results = [result.to_json() for result in scores]
    stressed: dict[str, StressScore] = {}
    if protocol == 2:
        if stress:
            stressed = _stressed(opened, plant, draws, in_process, workers, scheduler)
        for values in results:
            own = stressed.get(values["name"])
            values["stress"] = None if own is None else own.to_json()
    emit(results[0] if len(results) == 1 else {"submissions": results}, json)
    console = Console(stderr=str(json) == "-")
    console.print(_table(results))
    if protocol == 2:
        console.print(_normalised_table(results))
    if stressed:
        from ventbench.cli.stress import stress_table

        console.print(stress_table([own.to_json() for own in stressed.values()]))
    because = dict.fromkeys(reason for result in scores for reason in result.not_official_because)
    if because:
        Console(stderr=True).print(
            f"These scores are not official: {', '.join(because)}.", style="yellow"
        )
    for result in scores:
        for failure in result.failures[:3]:
            Console(stderr=True).print(failure.message, style="red", markup=False)
    if out is not None:
        for path in _keep(out, scores, stressed, report):
            console.print(f"wrote {path}", markup=False, highlight=False)
    if record is not None:
        from ventbench.board import create
        from ventbench.plants import frozen

        for path in create.keep(record, scores, frozen.load(protocol), stressed):
            console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
    if any(result.failures for result in (*scores, *stressed.values())):
        raise typer.Exit(1)


def _stressed(
    entries: list[Submission], plant: str, draws: int, in_process: bool, workers: int,
    scheduler: str | None,
) -> dict[str, StressScore]:  # fmt: skip
    """Stress scores, by name, of the entries that need not be told the lung."""
    from functools import partial

    from ventbench.stress.results import DRAWS
    from ventbench.stress.score import score_stress

    fitting = [entry for entry in entries if "robustness" in entry.manifest.tracks]
    for entry in entries:
        if entry not in fitting:
            name = entry.manifest.name
            notes().print(f"{name} must be told its lung: it has no stress score")
    work = partial(
        score_stress,
        simulator=plant,
        draws=DRAWS if draws >= DRAWS else 1,
        sandbox=not in_process,
    )
    scores = of_each_entry("stressing", work, fitting, workers, scheduler)
    return {own.submission.manifest.name: own for own in scores}


def _table(scores: list[dict[str, Any]]) -> Table:
    """Return a table with a row for each lung and a column for each submission."""
    from rich.table import Table

    def show(value: float | None) -> str:
        return "failed" if value is None else f"{value:.3f}"

    table = Table(title="Mean |pressure - target|, cmH2O (lower is better)")
    table.add_column("lung")
    for entry in scores:
        table.add_column(f"{entry['name']}\n{entry['track']}", justify="right")
    for lung in scores[0]["lungs"]:
        table.add_row(lung, *(show(entry["lungs"][lung]["score"]) for entry in scores))
    table.add_section()
    table.add_row("mean", *(show(entry["score"]) for entry in scores), style="bold")
    if scores[0]["draws"]:
        drawn = [entry["draws"] for entry in scores]
        table.add_row("mean of the draws", *(show(draws["score"]) for draws in drawn))
        table.add_row("95 % interval", *("..".join(map(show, draws["ci95"])) for draws in drawn))
    return table


def _normalised_table(scores: list[dict[str, Any]]) -> Table | str:
    """Return the normalised scores: a row for each lung, a column for each submission."""
    from rich.table import Table

    if any(entry["normalised"] is None for entry in scores):
        return "There are no normalised scores: `ventbench headroom` has not computed these cells."

    def show(value: float | None) -> str:
        return "failed" if value is None else f"{value:.1f}"

    def mean(values: dict[str, Any]) -> float | None:
        return (values["draws"] or {"score": values["nominal"]})["score"]

    over = "over the draws" if scores[0]["draws"] else "nominal"
    table = Table(title=f"Normalised score, {over}: 0 = best attainable, 100 = best PID")
    table.add_column("lung")
    for entry in scores:
        table.add_column(f"{entry['name']}\n{entry['track']}", justify="right")
    for lung in scores[0]["lungs"]:
        table.add_row(lung, *(show(mean(entry["lungs"][lung]["normalised"])) for entry in scores))
    table.add_section()
    table.add_row("mean", *(show(mean(entry["normalised"])) for entry in scores), style="bold")
    if scores[0]["draws"]:
        drawn = [entry["normalised"]["draws"] for entry in scores]
        table.add_row("95 % interval", *("..".join(map(show, draws["ci95"])) for draws in drawn))
    return table


def _keep(
    out: Path, scores: list[Score], stressed: dict[str, StressScore], report: bool
) -> list[Path]:
    written = [out / result.submission.manifest.name for result in scores]
    for folder, result in zip(written, scores, strict=True):
        result.save(folder)
    for name, own in stressed.items():
        own.save(out / name)
    if report and stressed:
        from ventbench.views.stress import write_stress_chart

        values = [own.to_json() for own in stressed.values()]
        written.append(write_stress_chart(out / "stress.png", values))
    if report:
        from ventbench import views

        runs = [result.trajectories for result in scores]
        values = [result.to_json() for result in scores]
        written.append(views.write_report(out / "report.html", runs, values))
        written.append(views.write_rerun(out / "scores.rrd", runs))
    return written


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(score)
