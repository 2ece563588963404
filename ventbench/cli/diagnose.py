"""``ventbench diagnose``: the physics that a simulator lacks, from a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ventbench.cli.options import Clip, JsonFile, Pad, PlantName, claim_out, counted, emit, notes
from ventbench.cli.options import bars as progress_bars

#: Share of a diagnosis before which its remaining time is a guess.
_TOO_EARLY = 0.15

if TYPE_CHECKING:
    from ventbench.diagnosis.result import Diagnosis
    from ventbench.recordings.breaths import Breaths


def diagnose(
    recordings: Annotated[
        Path, typer.Argument(help="CSV, CSV.GZ or Parquet file in the public schema.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="DIR", callback=claim_out, help="Folder for the results.")
    ],
    plant: PlantName = "physics",
    simulated: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Instead of --plant: CSV or Parquet with breath_id, a column simulated (cmH2O) "
            "and perhaps time_step (s); may be the recording itself with that column.",
        ),
    ] = None,
    drive: Annotated[
        str,
        typer.Option(
            metavar="valve|flow",
            help="What the model follows: the recorded commands, or the recorded flow. By default "
            "the flow only if u_in is zero throughout.",
        ),
    ] = "auto",
    lung: Annotated[
        str | None, typer.Option(metavar="R20C50", help="Only the breaths of this lung.")
    ] = None,
    patient: Annotated[
        bool,
        typer.Option(
            "--patient",
            help="A patient (or an active simulator) is ventilated and may breathe. Without this "
            "option the lung is a test lung, which makes no effort.",
        ),
    ] = False,
    passive: Annotated[bool, typer.Option("--passive", hidden=True)] = False,
    clip: Clip = False,
    pad: Pad = False,
    json: JsonFile = None,
) -> None:
    """Find the physics that a simulator lacks when it differs from a recording.

    Reports where they differ, which mechanisms are missing and with which parameters (or where in
    the model an effect outside the library acts), and how much the corrected simulator gains on
    held-out breaths. R, C, the expiratory resistance and PEEP are always refitted. Writes
    diagnosis.json, report.html, diagnosis.rrd and, if the simulator has plants, corrected.json,
    which every `--plant` option accepts.

    Sampling rates from 20 to 1000 Hz are taken as they are. A simulator in plain Python is
    `--plant module:function`; one in another program writes `--simulated answers.csv`.

    Example: `ventbench diagnose recording.csv --lung R20C50 --out runs/diagnosis`
    """
    from rich.console import Console

    from ventbench import recordings as files
    from ventbench.base import errors
    from ventbench.base.errors import InputError

    if drive not in ("auto", "valve", "flow"):
        raise InputError(f"--drive {drive}: choose auto, valve or flow")
    if simulated is not None and plant != "physics":
        raise InputError("--simulated stands in place of --plant; give one of them")

    if patient and passive:
        raise InputError("--patient and --passive contradict each other; choose one of them")
    errors.require("jinja2", "rerun")
    said = notes()
    with progress_bars() as shown:
        reading = counted(shown, f"reading {recordings}")
        breaths = files.load(recordings, clip=clip, pad=pad, progress=reading)
    for note in breaths.notes:
        said.print(f"note: {note}", markup=False, highlight=False)
    diagnosis = _diagnose(breaths, plant, simulated, lung, patient, drive)
    written = diagnosis.save(out)
    emit(diagnosis.as_dict(), json)
    console = Console(stderr=str(json) == "-")
    verdict, *others = str(diagnosis).splitlines()
    console.print(verdict, style="bold", markup=False, highlight=False)
    for text in others:
        console.print(text, markup=False, highlight=False)
    for path in written:
        console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)


def _diagnose(
    breaths: Breaths, plant: str, simulated: Path | None, lung: str | None, patient: bool,
    drive: str,
) -> Diagnosis:  # fmt: skip
    """Diagnose with a progress bar that says what is done and how long it will take."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from ventbench.base import compilation
    from ventbench.diagnosis.diagnose import diagnose as find
    from ventbench.plants.catalog import load_simulated, load_simulators

    compilation.keep()
    simulators = load_simulated(simulated, breaths) if simulated else load_simulators(plant)
    console = notes()
    lungs = 1 if lung is not None else len(breaths.by_lung_index)
    console.print(expected_time(len(breaths), lungs, compilation.is_warm()), highlight=False)
    columns = (
        TextColumn("{task.description}"), BarColumn(bar_width=20), TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as bars:
        task = bars.add_task("diagnosing", total=1.0, left="")

        def progress(what: str, share: float) -> None:
            elapsed = bars.tasks[task].elapsed or 0.0
            left = remaining(elapsed, share)
            bars.update(task, description=what, completed=share, left=left)

        return find(
            breaths,
            simulator=simulators,
            lung=lung,
            patient=patient,
            drive=drive,  # type: ignore[arg-type]
            progress=progress,
        )


def expected_time(breaths: int, lungs: int, warm: bool) -> str:
    """How long a diagnosis usually takes, in words.

    Args:
        breaths: number of breaths.
        lungs: number of lungs among them.
        warm: whether compiled functions are kept on this machine.
    """
    usual = "10 s to a minute" if lungs == 1 else "one to five minutes"
    text = (
        f"diagnosing {breaths} breaths of {lungs} lung{'s' if lungs > 1 else ''}: usually {usual}"
    )
    if not warm:
        text += "; the first run on a machine compiles for half a minute more"
    return f"{text}. Ctrl-C stops it; nothing is written before the end."


def remaining(elapsed: float, share: float) -> str:
    """Remaining time in words, from the time so far and the share that is done."""
    if share < _TOO_EARLY or elapsed < 1.0:
        return ""
    left = elapsed * (1.0 - share) / share
    if left < 90.0:
        return f"about {max(left, 1.0):.0f} s left"
    return f"about {left / 60.0:.0f} min left"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(diagnose)
