"""``ventbench diagnose``: what physics a simulator lacks, by a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ventbench.cli.options import Clip, JsonFile, Pad, PlantName, emit

if TYPE_CHECKING:
    from ventbench.diagnosis.result import Diagnosis
    from ventbench.recordings.breaths import Breaths


def diagnose(
    recordings: Annotated[Path, typer.Argument(help="CSV, CSV.GZ or Parquet, public schema.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where to write the four files.")],
    plant: PlantName = "physics",
    lung: Annotated[
        str | None, typer.Option(metavar="R20C50", help="Only the breaths of this lung.")
    ] = None,
    passive: Annotated[
        bool, typer.Option("--passive", help="A test lung: nobody breathes, no efforts are named.")
    ] = False,
    clip: Clip = False,
    pad: Pad = False,
    json: JsonFile = None,
) -> None:
    """Find what physics a simulator lacks when it differs from a recording.

    Says where they differ, names the missing mechanisms with their parameters (or where in the
    physics something without a name sits), and how much nearer the corrected simulator is on
    breaths that no fit has seen. R, C, expiratory resistance and PEEP are always refitted. Writes
    diagnosis.json, report.html, diagnosis.rrd and corrected.json, which `ventbench score --plant`
    takes.

    Example: `ventbench diagnose recording.csv --lung R20C50 --out runs/diagnosis`
    """
    from rich.console import Console

    from ventbench import extras
    from ventbench import recordings as files

    extras.require("jinja2", "rerun")
    progress = Console(stderr=True)
    with progress.status(f"reading {recordings}"):
        breaths = files.load(recordings, clip=clip, pad=pad)
    for note in breaths.notes:
        progress.print(f"note: {note}", markup=False, highlight=False)
    if lung is not None:
        lung, breaths = _only(recordings, breaths, lung)
    found = _diagnose(breaths, plant, lung, passive)
    out.mkdir(parents=True, exist_ok=True)
    written = keep(out, found)
    emit(found.as_dict(), json)
    console = Console(stderr=str(json) == "-")
    _say(console, found)
    for path in written:
        console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)


def keep(out: Path, found: Diagnosis) -> list[Path]:
    """Write the four files of a diagnosis, each in one step.

    Args:
        out: folder.
        found: what to write.

    Returns:
        Their paths.
    """
    import ventbench
    from ventbench import files
    from ventbench.plants.plant_files import save_plants
    from ventbench.views.diagnosis import write_report, write_rerun

    recorded = found.traces.breaths
    about = {
        "corrected": found.simulator,
        "mechanisms": [item.name for item in found.mechanisms],
        "recording": recorded.source,
        "recording_sha256": recorded.sha256,
        "ventbench": ventbench.__version__,
    }
    diagnosis, corrected = out / "diagnosis.json", out / "corrected.json"
    files.write_json(diagnosis, found.as_dict())
    save_plants(corrected, found.plants, about)
    report = write_report(out / "report.html", found)
    return [diagnosis, report, write_rerun(out / "diagnosis.rrd", found), corrected]


def _only(recordings: Path, breaths: Breaths, name: str) -> tuple[str, Breaths]:
    """Breaths of one lung, and its id as it is written everywhere."""
    from ventbench.errors import InputError
    from ventbench.lungs import lung

    name = lung(name).id
    there = breaths.by_lung_index
    if name not in there:
        raise InputError(
            f"{recordings} has no breath of lung {name}; choose one of {', '.join(there)}"
        )
    return name, breaths.select(there[name])


def _diagnose(breaths: Breaths, plant: str, lung: str | None, passive: bool) -> Diagnosis:
    """Run it under a bar of progress."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from ventbench import compilation
    from ventbench.diagnosis.diagnose import diagnose as find
    from ventbench.plants.catalog import load_simulators

    compilation.keep()
    simulators = load_simulators(plant)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("diagnosing", total=1.0)

        def progress(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share)

        return find(breaths, simulator=simulators, lung=lung, passive=passive, progress=progress)


def _say(console: Any, found: Diagnosis) -> None:
    from ventbench.diagnosis import report_text

    verdict, *others = report_text.sentences(found)
    console.print(verdict, style="bold", markup=False, highlight=False)
    for text in others:
        console.print(text, markup=False, highlight=False)
    for place in found.location[:3]:
        console.print(
            f"  {report_text.error_region(place, found.noise[0])}", markup=False, highlight=False
        )


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(diagnose)
