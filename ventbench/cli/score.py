"""``ventbench score``, ``new``, ``check``: work on submissions; and limits of scores.

The limits are the bounds of any controller (``headroom``).
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from ventbench.base.errors import InputError, require
from ventbench.cli.options import (
    Entries,
    InProcess,
    JsonFile,
    Scheduler,
    SimulatorName,
    Workers,
    bar,
    claim_out,
    complete_entries,
    map_entries,
    notes,
    table_of,
    written_console,
)

if TYPE_CHECKING:
    from rich.table import Table

    from ventbench.base.executor import Progress
    from ventbench.entries.folder import Submission
    from ventbench.entries.result import Score

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
    simulator: SimulatorName = "frozen",
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
    `--simulator` the lungs are its own, and the score is not official. Several controllers
    are scored in turn, or at the same time with `--workers` or `--scheduler`.

    Example: `ventbench score submissions/pid_best --json score.json`

    Example: `ventbench score adaptive_pid --track all --draws 20 --record runs/record`
    """
    from functools import partial

    from ventbench.entries.folder import open_submission
    from ventbench.entries.runs import DRAWS
    from ventbench.plants.catalog import load_simulators

    if record is not None and (draws < 20 or stress not in (None, 0, DRAWS)):
        raise InputError("--record needs all published draws: give --draws 20, without --stress")
    if report and out is None:
        raise InputError("--report needs --out DIR to write to")
    if report:
        require("jinja2", "rerun")
    opened = [open_submission(name) for name in names]
    entries = [entry.manifest.name for entry in opened]
    if len(set(entries)) < len(entries):
        raise InputError(f"two submissions have the same name: {', '.join(sorted(entries))}")
    if record is not None and simulator != "frozen":
        raise InputError("--record needs the frozen simulators: leave out --simulator")
    load_simulators(simulator)  # whatever is wrong with it is told before anything runs
    if stress and track is None:
        track = "robustness"
    if stress is None:
        stress = DRAWS if draws >= 20 else 0
    jobs = [job for entry in opened for job in _jobs(entry, track, stress)]
    work = partial(_run, simulator=simulator, draws=draws, sandbox=not in_process)
    scores = map_entries("scoring", work, jobs, workers, scheduler)
    results = [result.to_json() for result in scores]
    console = written_console(results[0] if len(results) == 1 else {"submissions": results}, json)
    for result in scores:
        console.print(str(result), soft_wrap=True, markup=False, highlight=False)
    if len(scores) > 1 or draws:
        console.print(_table(results))
    if out is not None:
        for path in _keep(out, scores, report):
            console.print(f"wrote {path}", soft_wrap=True)
    if record is not None:
        from ventbench.board import create
        from ventbench.plants import frozen

        drafts = [create.create(result, frozen.load()) for result in scores]
        for path in [draft.save(record) for draft in drafts]:
            console.print(f"wrote {path}", soft_wrap=True)
    if any(result.failed for result in scores):
        raise typer.Exit(1)


def _jobs(entry: Submission, track: Track | None, stress: int) -> list[tuple[Submission, str, int]]:
    """What :func:`_run` takes, for each track that an entry is scored on."""
    entered = entry.manifest.tracks
    tracks = entered if track == "all" else (track or entered[0],)
    if stress and "robustness" not in tracks:
        notes().print(f"{entry.manifest.name} is told its lung: no score under missing physics")
    return [(entry, name, stress if name == "robustness" else 0) for name in tracks]


def _run(
    entry: Submission, track: str, stress: int, *, progress: Progress | None = None, **options: Any
) -> Score:
    """Score an entry on a track; in this process or in another one."""
    from ventbench.entries import scoring

    return scoring.score(entry, track=track, stress=stress, progress=progress, **options)


def _table(results: list[dict[str, Any]]) -> Table:
    """Scores side by side, a row each, with their 95 % intervals; no columns of ``-`` alone."""

    def formatted(values: dict[str, Any] | None, digits: int) -> str:
        if values is None:
            return "-"
        if values["score"] is None:
            return "failed"
        low, high = values.get("ci95", (None, None))
        interval = "" if low is None or high is None else f" {low:.{digits}f}..{high:.{digits}f}"
        return f"{values['score']:.{digits}f}{interval}"

    rows = []
    for values in results:
        normalised, stress = values["normalised"], values["stress"]
        ranked = normalised and (normalised["draws"] or {"score": normalised["nominal"]})
        survived = "-" if stress is None else f"{100 * stress['survived']:.1f} %"
        scores = (
            formatted(values, 3),
            formatted(values["draws"], 3),
            formatted(ranked, 1),
            formatted(stress, 3),
        )
        rows.append((f"{values['name']}, {values['track']}", *scores, survived))
    names = ("entry", "nominal", "draws", "normalised", "missing physics", "survived")
    some = [k for k in range(len(names)) if any(row[k] != "-" for row in rows)]
    return table_of(
        "Mean |pressure - target|, cmH2O (lower is better)",
        [names[k] for k in some],
        [[row[k] for k in some] for row in rows],
        caption="normalised: 0 = best attainable, 100 = best PID",
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


def new(
    name: Annotated[
        str,
        typer.Argument(
            help="At most 40 lower-case letters, digits and underscores, starting with a letter."
        ),
    ],
    family: Annotated[str, typer.Option(help="Kind: pid, residual, ppo, dqn or other.")] = "pid",
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder in which NAME/ is written.")
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

    path = scaffold.create(name, family, out, network)
    typer.echo(f"wrote {path}: " + ", ".join(sorted(entry.name for entry in path.iterdir())))
    typer.echo(f"next: ventbench check {path} && ventbench score {path}")


def check(
    submission: Annotated[
        str,
        typer.Argument(
            help="Folder or name of a bundled submission.", autocompletion=complete_entries
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
    console = written_console(report.to_json(), json)
    for line in report.lines():
        console.print(line, soft_wrap=True)
    if not report.ok:
        raise typer.Exit(1)


#: Cells of the second optimiser: every so many of all.
_EVERY = 31


def headroom(
    out: Annotated[Path, typer.Option(metavar="FILE", help="File of the reference errors.")] = Path(
        "runs/bounds-v2.npz"
    ),
    check: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Check a file instead of making one: its commands must attain its errors, and a "
            "second optimiser must find nothing better.",
        ),
    ] = None,
    workers: Workers = 0,
    scheduler: Scheduler = None,
    json: JsonFile = None,
) -> None:
    """Compute the best attainable error and the best PID of every cell of the development draws.

    Commands are optimised for each cell with everything known; the best PID of a lung is searched
    for without a grid's edge, on the rigs of the training. Takes minutes; the same command
    continues.

    Example: `ventbench board headroom --check data/bounds-v2.npz`
    """
    from ventbench.base.executor import executor
    from ventbench.entries import reference as references
    from ventbench.plants.rigs import load_rigs
    from ventbench.task import draws, protocol
    from ventbench.train.pid_search import best_pids

    rigs = load_rigs()
    rig_draws = rigs.draws(draws.COUNT)
    plants, cells = rigs.cells(rig_draws, protocol.PIPS)
    identity = references.settings(rigs.about, rig_draws.about())
    if check is not None:
        computed = references.load(check)
        references.reference_of(rigs.about, rig_draws.about(), computed)
        result = references.checked(computed, plants, cells, every=_EVERY)
        console = written_console(result, json)
        for key, value in result.items():
            console.print(f"{key}: {value}")
        if not result["sound"]:
            raise typer.Exit(1)
        return
    parts = out.with_suffix(".parts")
    with bar("best PID of each lung") as progress:
        pids = best_pids(rigs, progress=progress)
    with bar("best attainable") as progress, executor(workers, scheduler) as pool:
        computed = references.compute(
            plants, cells, pids.gains, identity, folder=parts, pool=pool, progress=progress
        )
    sha256 = computed.save(out)
    shutil.rmtree(parts)  # they are in the file now
    summary = {
        "file": str(out),
        "sha256": sha256,
        "gains": computed.gains.tolist(),
        "searches_agree": pids.agree.tolist(),
        "attainable": float(computed.attainable.mean()),
        "lower": float(computed.lower.mean()),
        "pid": float(computed.pid.mean()),
    }
    written_console(summary, json).print(
        f"wrote {out}\nmean over cells, first step left out: best attainable "
        f"{summary['attainable']:.3f} cmH2O (at least {summary['lower']:.3f}), best PID "
        f"{summary['pid']:.3f}\nSHA-256 {sha256}",
        soft_wrap=True,
    )


def stressors(json: JsonFile = None) -> None:
    """List the stressors, which are missing physics, and their strengths.

    Example: `ventbench list stressors`
    """
    import dataclasses

    from ventbench.task.stressors import PAIRS, STRESSORS, VERSION

    rows = []
    for line in STRESSORS:
        strengths = (f"{value:.3g}" for value in (line.mild, line.strong))
        how = {"add": "", "scale": " (factor)", "label": " (label)"}[line.rule]
        rows.append((line.category, line.name, line.title, line.strength + how, *strengths))
    columns = ("category", "stressor", "what happens", "changes", "mild", "strong")
    lines, pairs = [dataclasses.asdict(x) for x in STRESSORS], [list(pair) for pair in PAIRS]
    console = written_console({"version": VERSION, "stressors": lines, "pairs": pairs}, json)
    console.print(table_of(f"Stressors, version {VERSION}", columns, rows, left=columns[:4]))
    console.print("Pairs, both mild: " + ", ".join(" + ".join(pair) for pair in PAIRS))


def entries(json: JsonFile = None) -> None:
    """List the submissions that come with ventbench: names that `ventbench score` takes.

    Example: `ventbench list entries`
    """
    from ventbench.entries.folder import bundled, open_submission

    manifests = [open_submission(name).manifest for name in bundled()]
    columns = ("submission", "family", "tracks", "what it is")
    rows = [(m.name, m.family, ", ".join(m.tracks), m.description) for m in manifests]
    values = [dict(zip(columns, row, strict=True)) for row in rows]
    written_console({"entries": values}, json).print(
        table_of("Submissions that come with ventbench", columns, rows, left=columns)
    )
