"""``ventbench score``, ``transfer``, ``new`` and ``check``: write, check and score submissions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
    notes,
    of_each_entry,
)

if TYPE_CHECKING:
    from rich.table import Table

    from ventbench.entries.folder import Submission
    from ventbench.entries.result import Score
    from ventbench.entries.runner import Progress
    from ventbench.stress.score import StressScore

Track = Literal["performance", "robustness", "stress", "all"]


def score(
    names: Annotated[
        list[str],
        typer.Argument(metavar="SUBMISSION...", help="Folders or names of bundled submissions."),
    ],
    track: Annotated[
        Track | None,
        typer.Option(
            help="Track to score; default: the first of the submission. `stress` runs it under "
            "missing physics that it is not told of; `all` scores each track that it enters."
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
            help="Write a record of each track for `board add` here; needs --draws 20. Records of "
            "the robustness track hold the stress score too.",
        ),
    ] = None,
    plant: PlantName = "frozen",
    stress: Annotated[
        bool | None,
        typer.Option(
            help="Also run entries of the robustness track under missing physics, six draws of "
            "each lung; default: with --draws 20."
        ),
    ] = None,
    in_process: Annotated[
        bool,
        typer.Option("--in-process", help="Run without the sandbox; only for code that you trust."),
    ] = False,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    json: JsonFile = None,
) -> None:
    """Score controllers on the six frozen lung simulators.

    The paper's score is the mean |pressure - target| over the inspirations, cmH2O, without noise
    on the reference rig of each lung; lower is better. With `--draws 20` the ranked score stands
    beside it: normalised, on all rigs of each lung, and the score under missing physics. Each
    controller runs in sandboxed processes that have no access to the simulators. With another
    `--plant` the lungs are those of that plant, and the score is not official. Several controllers
    are scored in turn, or at the same time with `--workers` or `--scheduler`.

    Example: `ventbench score submissions/pid_best --json score.json`

    Example: `ventbench score adaptive_pid --track all --draws 20 --record runs/record`
    """
    from functools import partial

    from rich.console import Console

    from ventbench.base import errors
    from ventbench.base.errors import InputError
    from ventbench.entries.folder import open_submission
    from ventbench.entries.result import Score
    from ventbench.plants.catalog import load_simulators

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
        errors.require("jinja2", "rerun")
    opened = [open_submission(name) for name in names]
    entries = [entry.manifest.name for entry in opened]
    if len(set(entries)) < len(entries):
        raise InputError(f"two submissions have the same name: {', '.join(sorted(entries))}")
    if record is not None and plant != "frozen":
        raise InputError("--record needs the official simulators: leave out --plant")
    load_simulators(plant)  # whatever is wrong with it is told before anything runs
    tracks = [
        entry.manifest.tracks if track == "all" else (track or entry.manifest.tracks[0],)
        for entry in opened
    ]
    jobs = [(entry, each) for entry, own in zip(opened, tracks, strict=True) for each in own]
    # Stress takes longest: beside other work it comes first.
    stress = draws >= 20 if stress is None else stress
    under_stress = [(entry, "stress") for entry in opened if stress]
    jobs = [job for job in under_stress if _has_stress_score(job[0])] + jobs
    work = partial(_run, simulator=plant, draws=draws, sandbox=not in_process)
    done = of_each_entry("scoring", work, jobs, workers, scheduler)
    scores = [result for result in done if isinstance(result, Score)]
    stressed = {
        result.submission.manifest.name: result for result in done if not isinstance(result, Score)
    }
    results = [result.to_json() for result in scores]
    for values in results:
        own = stressed.get(values["name"])
        values["stress"] = None if own is None else own.to_json()
    emit(results[0] if len(results) == 1 else {"submissions": results}, json)
    console = Console(stderr=str(json) == "-")
    console.print(_table(results))
    if all(entry["normalised"] is not None for entry in results):
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

        for path in create.keep(record, scores, frozen.load(), stressed):
            console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
    if any(result.failures for result in (*scores, *stressed.values())):
        raise typer.Exit(1)


def _run(
    entry: Submission,
    track: str | None,
    *,
    simulator: str,
    draws: int,
    sandbox: bool,
    progress: Progress | None = None,
) -> Score | StressScore:
    """Score an entry on a track, which may be ``"stress"``; in this process or in another one."""
    if track == "stress":
        from ventbench.stress.results import DRAWS
        from ventbench.stress.score import score_stress

        return score_stress(
            entry, simulator=simulator, draws=DRAWS, sandbox=sandbox, progress=progress
        )
    from ventbench.entries import scoring

    return scoring.score(
        entry,
        simulator=simulator,
        track=track,
        draws=draws,
        sandbox=sandbox,
        progress=progress,
    )


def _has_stress_score(entry: Submission) -> bool:
    """Whether an entry need not be told its lung; says so if it must."""
    if "robustness" in entry.manifest.tracks:
        return True
    notes().print(f"{entry.manifest.name} must be told its lung: it has no stress score")
    return False


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


def _normalised_table(scores: list[dict[str, Any]]) -> Table:
    """Return the normalised scores: a row for each lung, a column for each submission."""
    from rich.table import Table

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
    """Write a folder for each entry, with one for each track in it where there are several."""
    from dataclasses import replace

    names = [result.submission.manifest.name for result in scores]
    several = len(set(names)) < len(names)
    written, runs = [], []
    for name, result in zip(names, scores, strict=True):
        run = result.trajectories
        written.append(out / name / result.track if several else out / name)
        runs.append(replace(run, name=f"{name}, {result.track}") if several else run)
        result.save(written[-1])
    for name, own in stressed.items():
        own.save(out / name)
    if report and stressed:
        from ventbench.pages.stress import write_stress_chart

        values = [own.to_json() for own in stressed.values()]
        written.append(write_stress_chart(out / "stress.png", values))
    if report:
        from ventbench import pages

        values = [result.to_json() for result in scores]
        written.append(pages.write_report(out / "report.html", runs, values))
        written.append(pages.write_rerun(out / "scores.rrd", runs))
    return written


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

    from ventbench.entries import transfer as transfers
    from ventbench.entries.folder import open_submission
    from ventbench.entries.runner import CountingRunner, InProcessRunner, Runner
    from ventbench.plants.rigs import load_rigs

    runner: Runner = InProcessRunner()
    if not in_process:
        from ventbench.sandbox.runner import SandboxRunner

        runner = SandboxRunner()
    opened = [open_submission(name) for name in names]
    rigs = load_rigs()
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


Family = Literal["pid", "residual", "ppo", "dqn", "other"]


def new(
    name: Annotated[
        str,
        typer.Argument(
            help="At most 40 lower-case letters, digits and underscores, starting with a letter."
        ),
    ],
    family: Annotated[Family, typer.Option(help="Kind of controller to start from.")] = "pid",
    folder: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="Folder in which NAME/ is written.")
    ] = Path("."),
) -> None:
    """Write a submission that can be scored at once; change it into your own.

    Example: `ventbench new demo && ventbench check demo && ventbench score demo`
    """
    from ventbench.entries import scaffold

    path = scaffold.create(name, family, folder)
    typer.echo(f"wrote {path}: " + ", ".join(sorted(entry.name for entry in path.iterdir())))
    typer.echo(f"next: ventbench check {path} && ventbench score {path}")


def check(
    submission: Annotated[str, typer.Argument(help="Folder or name of a bundled submission.")],
    in_process: Annotated[
        bool,
        typer.Option("--in-process", help="Run without the sandbox; only for code that you trust."),
    ] = False,
    json: JsonFile = None,
) -> None:
    """Report every problem that keeps a submission from the leaderboard.

    Reads its files, manifest and sources, then runs it for a few breaths in the sandbox. The exit
    code is 0 if it is ready, 1 if it has problems, and 2 if there is nothing to check or no sandbox
    to run it in.

    Example: `ventbench check submissions/mine --json check.json`
    """
    from ventbench.entries import contract
    from ventbench.entries.runner import InProcessRunner

    with bars() as shown:
        report = contract.check(
            submission,
            InProcessRunner() if in_process else None,
            progress=counted(shown, f"running {submission}"),
        )
    emit(report.to_json(), json)
    for line in report.lines():
        typer.echo(line, err=str(json) == "-")
    if not report.ok:
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(score)
    app.command()(transfer)
    app.command()(new)
    app.command()(check)
