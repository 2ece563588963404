"""``ventbench mechanics``: the lung by pressure and flow, whatever the ventilator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ventbench.cli.options import Clip, JsonFile, Pad, emit

if TYPE_CHECKING:
    from ventbench.mechanics import Mechanics, SurveyedRun


def mechanics(
    recordings: Annotated[
        Path,
        typer.Argument(help="Public schema with flow or volume, or a RespiraWorks Parquet file."),
    ],
    clip: Clip = False,
    pad: Pad = False,
    json: JsonFile = None,
) -> None:
    """Identify lungs from pressure with flow or volume, and check their labels.

    Needs no model of a valve, so that recordings of any ventilator will do: R, C and what else the
    lung needs, whether its label holds, and which known settings it may be. A RespiraWorks file
    gives a Markdown table of its runs.

    Example: `ventbench mechanics lab.csv`
    """
    from rich.console import Console

    progress = Console(stderr=True)
    console = Console(stderr=str(json) == "-")
    if _is_respiraworks(recordings):
        with progress.status(f"identifying the lungs of {recordings}"):
            runs = _survey(recordings)
        emit([_run(item) for item in runs], json)
        _say_runs(console, runs)
        return
    with progress.status(f"identifying the lungs of {recordings}"):
        lungs = _identify(recordings, clip=clip, pad=pad)
    emit([_lung(one) for one in lungs], json)
    console.print(_table(lungs))
    for one in lungs:
        for note in one.notes:
            console.print(f"{one.label}: {note}", markup=False, highlight=False)


def _is_respiraworks(path: Path) -> bool:
    """Whether it is Parquet with runs and tests; what is wrong with a file, its reader says."""
    import pyarrow as pa
    from pyarrow import parquet

    from ventbench.recordings.scan import kind_of

    if kind_of(path) != "parquet":
        return False
    try:
        return {"run", "test", "breath"} <= set(parquet.read_schema(path).names)
    except (pa.ArrowException, OSError):
        return False


def _survey(path: Path) -> tuple[SurveyedRun, ...]:
    from ventbench.errors import InputError
    from ventbench.mechanics import survey

    found = survey(path)
    if all(item.mechanics is None for item in found):
        raise InputError(f"{path}: no run has flow or volume; log one of them beside pressure")
    return found


def _identify(path: Path, *, clip: bool, pad: bool) -> tuple[Mechanics, ...]:
    from ventbench import recordings
    from ventbench.errors import InputError
    from ventbench.mechanics import identify

    breaths = recordings.load(path, clip=clip, pad=pad)
    if breaths.flow is None and breaths.volume is None:
        raise InputError(
            f"{path}: there is neither a column flow (mL/s) nor volume (mL); record one of them, "
            "or ask `ventbench diagnose`, which judges lungs by pressure alone"
        )
    try:
        return identify(breaths)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _lung(one: Mechanics) -> dict[str, Any]:
    """JSON values; what is not finite becomes null."""
    import dataclasses

    from ventbench import files

    plain = dataclasses.asdict(one) | {"settings": [lung.id for lung in one.settings]}
    return files.json_values(plain)


def _run(item: SurveyedRun) -> dict[str, Any]:
    run, found = item.run, item.mechanics
    about = {"run": run.name, "test": run.test, "drive": run.drive, "R": run.R, "C": run.C}
    return about | {"mechanics": None if found is None else _lung(found)}


def _say_runs(console: Any, runs: tuple[SurveyedRun, ...]) -> None:
    from ventbench.mechanics import survey_table

    # Lines of a Markdown table must not be broken.
    console.print(survey_table(runs), markup=False, highlight=False, soft_wrap=True)
    known = [item.mechanics for item in runs if item.mechanics is not None]
    holds = sum(one.match.label_matches for one in known)
    console.print(
        f"\nThe label holds in {holds} of {len(known)} runs; {len(runs) - len(known)} more have "
        "neither flow nor volume.",
        highlight=False,
    )


def _table(lungs: tuple[Mechanics, ...]) -> Any:
    from rich.table import Table

    table = Table(title="Lungs by pressure and flow: R in cmH2O s/L at 1 L/s, C in mL/cmH2O")
    for name in ("label", "R", "C", "label holds", "may be", "also needs"):
        table.add_column(name)
    for one in lungs:
        it = one.match
        table.add_row(
            one.label,
            f"{it.fitted_R:.1f} [{it.ci95_R[0]:.1f}, {it.ci95_R[1]:.1f}]",
            f"{it.fitted_C:.1f} [{it.ci95_C[0]:.1f}, {it.ci95_C[1]:.1f}]",
            "yes" if it.label_matches else "no",
            ", ".join(lung.id for lung in one.settings[:2]) or "none known",
            ", ".join(term.name for term in one.terms) or "-",
        )
    return table


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(mechanics)
