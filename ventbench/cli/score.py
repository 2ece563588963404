"""``ventbench score``, ``transfer``, ``new`` and ``check``: work on submissions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ventbench.base.errors import InputError, require
from ventbench.cli.options import (
    Entries,
    InProcess,
    JsonFile,
    OneTrack,
    PlantName,
    Scheduler,
    Workers,
    bar,
    claim_out,
    emit,
    known_entries,
    notes,
    of_each_entry,
    table_of,
    told,
)

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from ventbench.entries.folder import Submission
    from ventbench.entries.result import Score
    from ventbench.entries.scoring import Progress

Track = Literal["performance", "robustness", "all"]


def score(
    names: Entries,
    track: Annotated[
        Track | None,
        typer.Option(
            help="Track to score; default: the first of the submission, or with --stress the "
            "robustness track. `all` scores each track that it enters."
        ),
    ] = None,
    draws: Annotated[
        int,
        typer.Option(
            min=0,
            max=20,
            help="Number of the 20 published draws to run as well.",
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
            help="Also write report.html and scores.rrd to the folder of --out.",
        ),
    ] = False,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write a record of each track for `board add` here; needs --draws 20. Records of "
            "the robustness track hold the score under missing physics too.",
        ),
    ] = None,
    plant: PlantName = "frozen",
    stress: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=20,
            help="On the robustness track: number of draws to run under missing physics that the "
            "controller is not told of; default: 6 with --draws 20, else 0.",
        ),
    ] = None,
    in_process: InProcess = False,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    json: JsonFile = None,
) -> None:
    """Score controllers on the six frozen lung simulators.

    The paper's score is the mean |pressure - target| over the inspirations, cmH2O, without noise
    on the reference rig of each lung; lower is better. With `--draws 20` the ranked score stands
    beside it: normalised, on all rigs of each lung, and the score under missing physics. Each
    controller runs in sandboxed processes that have no access to the simulators. With another
    `--plant` the lungs are those of that plant, and the score is not official; beside a score on a
    `corrected.json` stands that on the simulator that was corrected. Several controllers
    are scored in turn, or at the same time with `--workers` or `--scheduler`.

    Example: `ventbench score submissions/pid_best --json score.json`

    Example: `ventbench score adaptive_pid --track all --draws 20 --record runs/record`
    """
    from functools import partial

    from ventbench.entries.folder import open_submission
    from ventbench.entries.runs import DRAWS
    from ventbench.plants.catalog import load_simulators
    from ventbench.plants.catalog import names as simulator_names

    if record is not None and (draws < 20 or stress not in (None, 0, DRAWS)):
        raise InputError(f"--record needs all published draws: add --draws 20 --stress {DRAWS}")
    if report and out is None:
        raise InputError("--report needs --out DIR to write to")
    if report:
        require("jinja2", "rerun")
    opened = [open_submission(name) for name in names]
    entries = [entry.manifest.name for entry in opened]
    if len(set(entries)) < len(entries):
        raise InputError(f"two submissions have the same name: {', '.join(sorted(entries))}")
    if record is not None and plant != "frozen":
        raise InputError("--record needs the official simulators: leave out --plant")
    tested = load_simulators(plant)  # whatever is wrong with it is told before anything runs
    if stress and track is None:
        track = "robustness"
    if stress is None:
        stress = DRAWS if draws >= 20 else 0
    jobs = []
    for entry in opened:
        entered = entry.manifest.tracks
        for each in entered if track == "all" else (track or entered[0],):
            jobs.append((entry, each, stress if each == "robustness" else 0))
        if stress and not any(job[0] is entry and job[2] for job in jobs):
            notes().print(f"{entry.manifest.name} is told its lung: no score under missing physics")
    work = partial(_run, simulator=plant, draws=draws, sandbox=not in_process)
    scores = of_each_entry("scoring", work, jobs, workers, scheduler)
    results = [result.to_json() for result in scores]
    given = str(tested.origin.get("corrected", ""))
    if given in simulator_names():
        before = partial(_run, simulator=given, draws=0, sandbox=not in_process)
        what = f"scoring on {given}, which was corrected,"
        unstressed = [(entry, each, 0) for entry, each, _ in jobs]
        for values, other in zip(
            results, of_each_entry(what, before, unstressed, workers, scheduler), strict=True
        ):
            values["given"] = _given(given, other.to_json(), values)
    console = told(results[0] if len(results) == 1 else {"submissions": results}, json)
    console.print(_table(results))
    if given in simulator_names():
        console.print(_corrected_table(results))
        _why_corrected(console, tested.origin, given, plant)
    if all(entry["normalised"] is not None for entry in results):
        console.print(_normalised_table(results))
    if any(values["stress"] for values in results):
        console.print(_stress_table([values["stress"] for values in results if values["stress"]]))
        _compare(console, scores)
    because = dict.fromkeys(reason for result in scores for reason in result.not_official_because)
    if because:
        typer.secho(f"These scores are not official: {', '.join(because)}.", fg="yellow", err=True)
    failures = [
        failure
        for result in scores
        for failures in (result.failures, result.stressed.failures if result.stressed else ())
        for failure in failures[:3]
    ]
    for failure in failures:
        typer.secho(failure.message, fg="red", err=True)
    if out is not None:
        for path in _keep(out, scores, report):
            console.print(f"wrote {path}", soft_wrap=True)
    if record is not None:
        from ventbench.board import create
        from ventbench.plants import frozen

        drafts = [create.create(result, frozen.load()) for result in scores]
        for path in [draft.save(record) for draft in drafts]:
            console.print(f"wrote {path}", soft_wrap=True)
    if failures:
        raise typer.Exit(1)


def _run(
    entry: Submission, track: str, stress: int, *, progress: Progress | None = None, **options: Any
) -> Score:
    """Score an entry on a track; in this process or in another one."""
    from ventbench.entries import scoring

    return scoring.score(entry, track=track, stress=stress, progress=progress, **options)


def _shown(value: float | None, digits: int = 3) -> str:
    return "failed" if value is None else f"{value:.{digits}f}"


def _by_lung(
    title: str, scores: list[dict[str, Any]], cell: Callable[[dict[str, Any], str], str],
    total: Callable[[dict[str, Any]], str],
) -> Table:  # fmt: skip
    """Return a table with a row for each lung and the mean, and a column for each submission."""
    columns = ("lung", *(f"{entry['name']}\n{entry['track']}" for entry in scores))
    rows = ((lung, *(cell(entry, lung) for entry in scores)) for lung in scores[0]["lungs"])
    table = table_of(title, columns, rows)
    table.add_section()
    table.add_row("mean", *map(total, scores), style="bold")
    return table


def _add_interval(table: Table, drawn: list[dict[str, Any]], digits: int = 3) -> None:
    limits = ("..".join(_shown(limit, digits) for limit in own["ci95"]) for own in drawn)
    table.add_row("95 % interval", *limits)


def _table(scores: list[dict[str, Any]]) -> Table:
    """Return the paper's scores."""
    table = _by_lung(
        "Mean |pressure - target|, cmH2O (lower is better)", scores,
        lambda entry, lung: _shown(entry["lungs"][lung]["score"]),
        lambda entry: _shown(entry["score"]),
    )  # fmt: skip
    if scores[0]["draws"]:
        drawn = [entry["draws"] for entry in scores]
        table.add_row("mean of the draws", *(_shown(own["score"]) for own in drawn))
        _add_interval(table, drawn)
    return table


def _given(name: str, before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Score on the simulators that were corrected, on the lungs of the corrected ones."""
    lungs = {lung: before["lungs"].get(lung, {"score": None})["score"] for lung in after["lungs"]}
    known = None not in lungs.values()
    score = sum(filter(None, lungs.values())) / len(lungs) if known else None
    return {"simulators": name, "score": score, "lungs": lungs}


def _corrected_table(results: list[dict[str, Any]]) -> Table:
    """Return each entry's score before and after the correction."""

    def cells(given: float | None, corrected: float | None) -> str:
        if given is None or corrected is None:
            return "failed"
        return f"{given:.3f} -> {corrected:.3f} ({corrected - given:+.3f})"

    name = results[0]["given"]["simulators"]
    return _by_lung(
        f"From {name}, the given simulator, to the corrected one, cmH2O", results,
        lambda entry, lung: cells(entry["given"]["lungs"][lung], entry["lungs"][lung]["score"]),
        lambda entry: cells(entry["given"]["score"], entry["score"]),
    )  # fmt: skip


def _why_corrected(console: Console, origin: Mapping[str, Any], given: str, plant: str) -> None:
    """Say why the scores differ, and what to do."""
    from ventbench.physics.catalogue import everything

    known = everything()
    titles = [
        known[name].description.title if name in known else name
        for name in origin.get("mechanisms", ())
    ]
    lacks = ", ".join(titles) or "what its refitted parameters and unnamed term stand for"
    console.print(
        f"They differ because {given} lacks what the recording has: {lacks}. A controller that was "
        f"tuned on {given} does not know it: tune on the corrected simulator, "
        f"`ventbench tune pid --plant {plant}`.",
        soft_wrap=True,  # the command can be copied
    )


def _normalised_table(scores: list[dict[str, Any]]) -> Table:
    """Return the normalised scores."""

    def mean(values: dict[str, Any]) -> str:
        own = values["normalised"]
        return _shown((own["draws"] or {"score": own["nominal"]})["score"], 1)

    over = "over the draws" if scores[0]["draws"] else "nominal"
    table = _by_lung(
        f"Normalised score, {over}: 0 = best attainable, 100 = best PID", scores,
        lambda entry, lung: mean(entry["lungs"][lung]), mean,
    )  # fmt: skip
    if scores[0]["draws"]:
        _add_interval(table, [entry["normalised"]["draws"] for entry in scores], 1)
    return table


def _stress_table(scores: list[dict[str, Any]]) -> Table:
    """Return a table of scores under missing physics: figures, then a row for each category."""
    title = "Missing physics: mean |airway pressure - PIP|, cmH2O (lower is better)"
    table = table_of(title, ("", *(entry["name"] for entry in scores)))
    for column in table.columns[1:]:
        column.overflow = "fold"
    table.add_row("all stressors", *(_shown(entry["score"]) for entry in scores), style="bold")
    if None not in scores[0]["ci95"]:
        _add_interval(table, scores, 2)

    def add(name: str, text: Callable[[dict[str, Any]], str]) -> None:
        table.add_row(name, *map(text, scores))

    add("without stressors", lambda e: _shown(e["unstressed"]))
    add("runs survived", lambda e: f"{100 * e['survived']:.1f} %")
    add("unsafe runs", lambda e: f"{e['unsafe_runs']} of {e['stressed_runs']}")
    add("longest above PIP + 15 %, mean, s", lambda e: _shown(e["above_alarm_s"], 2))
    add("worst", lambda e: f"{_shown(e['worst_error'], 2)}\n{e['worst_condition']}")
    table.add_section()
    for category in scores[0]["categories"]:
        each = [entry["categories"][category] for entry in scores]
        shown = (
            f"{_shown(e['error_cmH2O'], 2)}, {100 * e['survived']:.0f} % survived" for e in each
        )
        table.add_row(category, *shown)
    return table


def _compare(console: Console, scores: list[Score]) -> None:
    """Paired differences under missing physics to the first entry."""
    import math

    first, *others = [score for score in scores if score.stressed is not None]
    assert first.stressed is not None
    for score in others:
        assert score.stressed is not None
        difference, (low, high) = score.stressed.difference(first.stressed)
        if math.isfinite(difference):
            console.print(
                f"{score.submission.manifest.name} less {first.submission.manifest.name}: "
                f"{difference:+.3f} cmH2O, paired 95 % interval {low:+.3f}..{high:+.3f}"
            )


def _keep(out: Path, scores: list[Score], report: bool) -> list[Path]:
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
    if report:
        from ventbench import pages

        values = [result.to_json() for result in scores]
        written.append(pages.write_report(out / "report.html", runs, values))
        written.append(pages.write_rerun(out / "scores.rrd", runs))
    return written


def transfer(
    names: Entries, track: OneTrack = None, in_process: InProcess = False, json: JsonFile = None
) -> None:
    """Score controllers on every rig and every member of the ensemble, without noise.

    Columns: the reference rig of each lung, which the nominal score uses; the same rig in the other
    members of the ensemble; the lung's other rigs; the rig on which no entry of ours was trained.

    Example: `ventbench transfer pid_best residual_mlp --json transfer.json`
    """
    from rich.text import Text

    from ventbench.entries import scoring as transfers
    from ventbench.entries.cells import runner_of
    from ventbench.entries.folder import open_submission
    from ventbench.plants.rigs import load_rigs

    opened = [open_submission(name) for name in names]
    rigs, results = load_rigs(), []
    for entry in opened:
        chosen = track or entry.manifest.tracks[0]
        with bar(f"running {entry.label}") as running:
            runner = runner_of(entry, sandbox=not in_process)
            runs = transfers.transfer(entry, rigs, track=chosen, runner=runner, progress=running)
        groups = transfers.by_group(runs, rigs)
        results.append({"name": entry.manifest.name, "track": chosen, "groups": groups})
    plants = results[0]["groups"]
    columns = ("entry", *(f"{group}\n{plants[group]['plants']} plants" for group in plants))
    errors = [[result["groups"][group]["error_cmH2O"] for group in plants] for result in results]
    best = [
        min((x for x in own if x is not None), default=None) for own in zip(*errors, strict=True)
    ]
    rows = []
    for result, own in zip(results, errors, strict=True):
        texts = ("-" if value is None else f"{value:.3f}" for value in own)
        cells = (
            Text(text, "bold") if value == least else text
            for text, value, least in zip(texts, own, best, strict=True)
        )
        rows.append((f"{result['name']}, {result['track']}", *cells))
    title = "Mean |pressure - target| on rigs, cmH2O (lower is better)"
    told({"entries": results}, json).print(table_of(title, columns, rows))


def new(
    name: Annotated[
        str,
        typer.Argument(
            help="At most 40 lower-case letters, digits and underscores, starting with a letter."
        ),
    ],
    family: Annotated[str, typer.Option(help="Kind: pid, residual, ppo, dqn or other.")] = "pid",
    folder: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="Folder in which NAME/ is written.")
    ] = Path("."),
    network: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Safetensors file of a trained network, see above."),
    ] = None,
) -> None:
    """Write a submission that can be scored at once; change it into your own.

    --network copies dense layers that were trained on observations of ventbench/Ventilator-v1, one
    or several, the newest last: the state of a policy of PyTorch, Stable-Baselines3 or flax, with
    some inputs as check.input and the actions that it gives for them as check.output, such as
    `save_file({**net.state_dict(), "check.input": x, "check.output": net(x)}, FILE)`. What stands
    between the layers is found out; a copy that is off by more than 1e-6 is refused.

    Example: `ventbench new demo && ventbench check demo && ventbench score demo`
    """
    from ventbench.entries import scaffold

    path = scaffold.create(name, family, folder, network)
    typer.echo(f"wrote {path}: " + ", ".join(sorted(entry.name for entry in path.iterdir())))
    typer.echo(f"next: ventbench check {path} && ventbench score {path}")


def check(
    submission: Annotated[
        str,
        typer.Argument(
            help="Folder or name of a bundled submission.", autocompletion=known_entries
        ),
    ],
    in_process: InProcess = False,
    json: JsonFile = None,
) -> None:
    """Report every problem that keeps a submission from the leaderboard.

    Reads its files, manifest and sources, then runs it for a few breaths in the sandbox. The exit
    code is 0 if it is ready, 1 if it has problems, and 2 if there is nothing to check or no sandbox
    to run it in.

    Example: `ventbench check submissions/mine --json check.json`
    """
    from ventbench.entries import contract
    from ventbench.entries.cells import InProcessRunner

    runner = InProcessRunner() if in_process else None
    with bar(f"running {submission}") as running:
        report = contract.check(submission, runner, progress=running)
    emit(report.to_json(), json)
    for line in report.lines():
        typer.echo(line, err=str(json) == "-")
    if not report.ok:
        raise typer.Exit(1)


COMMANDS = (score, transfer, new, check)
