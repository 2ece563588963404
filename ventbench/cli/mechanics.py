"""``ventbench mechanics``: lungs from pressure and flow, for any ventilator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ventbench.cli.options import Clip, JsonFile, Pad, bars, counted, emit

if TYPE_CHECKING:
    from ventbench.mechanics import Mechanics, SurveyedRun


def mechanics(
    recordings: Annotated[
        Path,
        typer.Argument(
            help="File in the public schema with flow or volume, or a RespiraWorks Parquet file."
        ),
    ],
    clip: Clip = False,
    pad: Pad = False,
    json: JsonFile = None,
) -> None:
    """Identify lungs from pressure with flow or volume, and check their labels.

    Needs no model of a valve and therefore accepts recordings of any ventilator. Reports R, C and
    further terms of the lung, whether its label holds, and which known settings it may be. For a
    RespiraWorks file it prints a Markdown table of the runs.

    Example: `ventbench mechanics lab.csv`
    """
    from rich.console import Console

    console = Console(stderr=str(json) == "-")
    if _is_respiraworks(recordings):
        with bars() as shown:
            runs = _survey(recordings, counted(shown, f"identifying the lungs of {recordings}"))
        emit([_run(run) for run in runs], json)
        _say_runs(console, runs)
        return
    lungs = _identify(recordings, clip=clip, pad=pad)
    emit([_lung(lung) for lung in lungs], json)
    console.print(_table(lungs))
    for lung in lungs:
        for note in lung.notes:
            console.print(f"{lung.label}: {note}", markup=False, highlight=False)


def _is_respiraworks(path: Path) -> bool:
    """Whether a file is Parquet with runs and tests; its reader reports what is wrong with it."""
    import pyarrow as pa
    from pyarrow import parquet

    from ventbench.recordings.scan import kind_of

    if kind_of(path) != "parquet":
        return False
    try:
        return {"run", "test", "breath"} <= set(parquet.read_schema(path).names)
    except (pa.ArrowException, OSError):
        return False


def _survey(path: Path, progress: Callable[[int, int], None]) -> tuple[SurveyedRun, ...]:
    from ventbench.base.errors import InputError
    from ventbench.mechanics import survey

    runs = survey(path, progress)
    if all(run.mechanics is None for run in runs):
        raise InputError(f"{path}: no run has flow or volume; log one of them beside pressure")
    return runs


def _identify(path: Path, *, clip: bool, pad: bool) -> tuple[Mechanics, ...]:
    from ventbench import recordings
    from ventbench.base.errors import InputError
    from ventbench.mechanics import identify

    with bars() as shown:
        reading = counted(shown, f"reading {path}")
        breaths = recordings.load(path, clip=clip, pad=pad, progress=reading)
    if breaths.flow is None and breaths.volume is None:
        raise InputError(
            f"{path}: there is neither a column flow (mL/s) nor volume (mL); record one of them, "
            "or use `ventbench diagnose`, which needs the pressure only"
        )
    try:
        with bars() as shown:
            return identify(breaths, counted(shown, f"identifying the lungs of {path}"))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _lung(mechanics: Mechanics) -> dict[str, Any]:
    """Return JSON values; numbers that are not finite become null."""
    import dataclasses

    from ventbench.base import files

    plain = dataclasses.asdict(mechanics) | {
        "settings": [setting.id for setting in mechanics.settings]
    }
    return files.json_values(plain)


def _run(surveyed: SurveyedRun) -> dict[str, Any]:
    run, mechanics = surveyed.run, surveyed.mechanics
    about = {"run": run.name, "test": run.test, "drive": run.drive, "R": run.R, "C": run.C}
    return about | {"mechanics": None if mechanics is None else _lung(mechanics)}


def _say_runs(console: Any, runs: tuple[SurveyedRun, ...]) -> None:
    from ventbench.mechanics import survey_table

    # Lines of a Markdown table must not be broken.
    console.print(survey_table(runs), markup=False, highlight=False, soft_wrap=True)
    known = [run.mechanics for run in runs if run.mechanics is not None]
    holds = sum(lung.match.label_matches for lung in known)
    console.print(
        f"\nThe label holds in {holds} of {len(known)} runs; {len(runs) - len(known)} more have "
        "neither flow nor volume.",
        highlight=False,
    )


def _table(lungs: tuple[Mechanics, ...]) -> Any:
    from rich.table import Table

    from ventbench.mechanics.labels import label_texts, tolerance_text, value_text

    table = Table(
        title="Lungs from pressure and flow: R in cmH2O/(L/s) at 1 L/s, C in mL/cmH2O",
        caption=f"A label holds with {tolerance_text()}, beyond the intervals.",
    )
    for name in ("label", "R", "C", "label holds", "may be", "also needs"):
        table.add_column(name)
    for lung in lungs:
        match = lung.match
        table.add_row(
            lung.label,
            value_text(match.fitted_R, match.ci95_R),
            value_text(match.fitted_C, match.ci95_C),
            *label_texts(match, lung.settings),
            ", ".join(term.name for term in lung.terms) or "-",
        )
    return table


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(mechanics)
