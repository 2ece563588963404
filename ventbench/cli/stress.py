"""The stress track of ``ventbench score``, and ``ventbench stressors``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ventbench.cli.options import JsonFile, emit, of_each_entry

if TYPE_CHECKING:
    from rich.table import Table

    from ventbench.entries.folder import Submission
    from ventbench.stress.score import StressScore


def score_entries(
    names: list[str],
    draws: int,
    out: Path | None,
    report: bool,
    plant: str,
    in_process: bool,
    json: Path | None,
    record: Path | None = None,
    parallel: tuple[int, str | None] = (0, None),
) -> None:
    """Score entries on the stress track; arguments are the options of ``ventbench score``.

    ``parallel`` holds its ``--workers`` and ``--scheduler``.

    A record of the stress track is that of the robustness track with the stress score in it, so
    that one is scored too.
    """
    from functools import partial

    import numpy as np
    from rich.console import Console

    from ventbench.base.errors import InputError
    from ventbench.entries.folder import open_submission
    from ventbench.stress.results import DRAWS
    from ventbench.stress.score import score_stress

    if report and out is None:
        raise InputError("--report needs --out DIR to write to")
    if record is not None and (draws not in (0, DRAWS) or plant != "frozen"):
        raise InputError(f"--record of the stress track needs {DRAWS} draws on the frozen rigs")
    opened = [open_submission(name) for name in names]
    work = partial(score_stress, simulator=plant, draws=draws or DRAWS, sandbox=not in_process)
    scores = of_each_entry("stressing", work, [(entry,) for entry in opened], *parallel)
    results = [result.to_json() for result in scores]
    emit(results[0] if len(results) == 1 else {"submissions": results}, json)
    console = Console(stderr=str(json) == "-")
    console.print(stress_table(results))
    for result in scores[1:]:
        difference, limits = result.difference(scores[0])
        if np.isfinite(difference):
            low, high = limits
            console.print(
                f"{result.submission.manifest.name} less {results[0]['name']}: {difference:+.3f} "
                f"cmH2O, paired 95 % interval {low:+.3f}..{high:+.3f}",
                highlight=False,
            )
    if out is not None:
        written = [out / result.submission.manifest.name for result in scores]
        for folder, result in zip(written, scores, strict=True):
            result.save(folder)
        if report:
            from ventbench.pages.stress import write_stress_chart

            written.append(write_stress_chart(out / "stress.png", results))
        for path in written:
            console.print(f"wrote {path}", markup=False, highlight=False)
    if record is not None:
        for path in _write_records(record, opened, scores, in_process, parallel):
            console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
    failed = [failure for result in results for failure in result["failures"]]
    for failure in failed[:3]:
        place = f"{failure['condition']}, {failure['lung']}, draw {failure['draw']}"
        Console(stderr=True).print(f"{place}: {failure['what']}", style="red", markup=False)
    if failed:
        raise typer.Exit(1)


def stressors(json: JsonFile = None) -> None:
    """List the stressors of the stress track and their strengths.

    Example: `ventbench stressors`
    """
    import dataclasses

    from rich.console import Console
    from rich.table import Table

    from ventbench.stress.stressors import PAIRS, STRESSORS, VERSION

    lines = [dataclasses.asdict(line) for line in STRESSORS]
    emit({"version": VERSION, "stressors": lines, "pairs": [list(pair) for pair in PAIRS]}, json)
    table = Table(title=f"Stressors, version {VERSION}")
    for name in ("category", "stressor", "what happens", "changes", "mild", "strong"):
        table.add_column(name, justify="right" if name in ("mild", "strong") else "left")
    for line in STRESSORS:
        strengths = (f"{value:.3g}" for value in (line.mild, line.strong))
        how = {"add": "", "scale": " (factor)", "label": " (label)"}[line.rule]
        table.add_row(line.category, line.name, line.title, line.strength + how, *strengths)
    console = Console(stderr=str(json) == "-")
    console.print(table)
    console.print("Pairs, both mild: " + ", ".join(" + ".join(pair) for pair in PAIRS))


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(stressors)


def _write_records(
    folder: Path,
    entries: list[Submission],
    stressed: list[StressScore],
    in_process: bool,
    parallel: tuple[int, str | None],
) -> list[Path]:
    """Score the robustness track too, and write records with both."""
    from functools import partial

    from ventbench.board import create
    from ventbench.entries import scoring
    from ventbench.plants import frozen
    from ventbench.task import draws

    work = partial(
        scoring.score,
        track="robustness",
        draws=draws.COUNT,
        sandbox=not in_process,
    )
    scores = of_each_entry("scoring", work, [(entry,) for entry in entries], *parallel)
    by_name = {own.submission.manifest.name: own for own in stressed}
    return create.keep(folder, scores, frozen.load(), by_name)


def stress_table(scores: list[dict[str, Any]]) -> Table:
    """Return a table of stress scores: the figures, then a row for each category."""
    from rich.table import Table

    def show(value: float | None, digits: int = 2) -> str:
        return "failed" if value is None else f"{value:.{digits}f}"

    table = Table(title="Stress track: mean |airway pressure - PIP|, cmH2O (lower is better)")
    table.add_column("")
    for entry in scores:
        table.add_column(entry["name"], justify="right", overflow="fold")
    table.add_row("all stressors", *(show(entry["score"], 3) for entry in scores), style="bold")
    limits = [entry["ci95"] for entry in scores]
    if None not in limits[0]:
        table.add_row("95 % interval", *("..".join(map(show, ends)) for ends in limits))
    table.add_row("without stressors", *(show(entry["unstressed"], 3) for entry in scores))
    table.add_row("runs survived", *(f"{100 * entry['survived']:.1f} %" for entry in scores))
    table.add_row("unsafe runs", *(f"{e['unsafe_runs']} of {e['stressed_runs']}" for e in scores))
    table.add_row("longest above PIP + 15 %, mean, s", *(show(e["above_alarm_s"]) for e in scores))
    table.add_row("worst", *(f"{show(e['worst_error'])}\n{e['worst_condition']}" for e in scores))
    table.add_section()
    for category in scores[0]["categories"]:
        table.add_row(
            category,
            *(
                f"{show(own['error_cmH2O'])}, {100 * own['survived']:.0f} % survived"
                for own in (entry["categories"][category] for entry in scores)
            ),
        )
    return table
