"""``ventbench diagnose`` and ``mechanics``: what a recording says of simulator and lung."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ventbench.base import files
from ventbench.base.errors import InputError, require
from ventbench.cli.options import (
    Clip,
    JsonFile,
    Missing,
    Pad,
    SimulatorName,
    bar,
    claim_out,
    complete_lungs,
    notes,
    read_recording,
    table_of,
    written_console,
)

if TYPE_CHECKING:
    from ventbench.mechanics import Mechanics
    from ventbench.mechanics.identify import Term
    from ventbench.recordings.breaths import Breaths

#: Heading of the options of ``--isolability``.
_PLANNED = "With --isolability"


def mechanics(
    recordings: Annotated[
        Path,
        typer.Argument(
            help="File in the public schema with flow or volume, the folder of a session of such "
            "files, or a RespiraWorks Parquet file."
        ),
    ],
    clip: Clip = False,
    pad: Pad = False,
    missing: Missing = None,
    json: JsonFile = None,
) -> None:
    """Identify lungs from pressure with flow or volume, and check their labels.

    Needs no model of a valve and therefore accepts recordings of any ventilator. Reports R, C and
    further terms of the lung, whether its label holds, and which known settings it may be. Files of
    one session, and RespiraWorks' runs of one day, share what is wrong with their sensors.

    Example: `ventbench mechanics lab.csv`
    """
    read = partial(read_recording, clip=clip, pad=pad, missing=missing)
    named = _of_runs(recordings) or _of_session(recordings, read)
    console = written_console([{"name": name} | _lung(lung) for name, lung in named.items()], json)
    console.print(_table(named))
    for name, lung in named.items():
        if lung.terms:
            console.print(f"{name} needs beyond R and C: {', '.join(map(_term, lung.terms))}.")
        for note in lung.notes:
            console.print(f"{name}: {note}")


def _of_runs(path: Path) -> dict[str, Mechanics]:
    """Lungs of a file of many runs, by run; those of a day are a session. None of other files."""
    from ventbench.mechanics import identify, share_faults
    from ventbench.recordings.foreign import import_runs

    runs = import_runs(path)
    measured = {
        name: breaths
        for name, breaths in runs.items()
        if breaths.flow is not None or breaths.volume is not None
    }
    if runs and not measured:
        raise InputError(f"{path}: no run has flow or volume; log one of them beside pressure")
    if len(measured) < len(runs):
        skipped = len(runs) - len(measured)
        notes().print(f"note: {skipped} of {len(runs)} runs have neither flow nor volume")
    by_run: dict[str, Mechanics] = {}
    with bar(f"identifying the lungs of {path}") as identifying:
        for name, breaths in measured.items():
            by_run[name] = identify(breaths)[0]
            identifying(len(by_run), len(measured))
    for day in {name.rpartition(" ")[0] for name in by_run}:
        of_day = [name for name in by_run if name.rpartition(" ")[0] == day]
        by_run |= zip(of_day, share_faults([by_run[name] for name in of_day]), strict=True)
    return {f"{name}: {lung.label}": lung for name, lung in by_run.items()}


def _of_session(path: Path, read: Callable[[Path], Breaths]) -> dict[str, Mechanics]:
    """Lungs of a file by label; of a folder by file and label."""
    from ventbench.mechanics import share_faults
    from ventbench.recordings.read import session_files

    paths = session_files(path)
    by_lung = {
        f"{file.stem}: {lung.label}" if len(paths) > 1 else lung.label: lung
        for file in paths
        for lung in _identify(file, read(file))
    }
    return dict(zip(by_lung, share_faults(list(by_lung.values())), strict=True))


def _identify(path: Path, breaths: Breaths) -> tuple[Mechanics, ...]:
    from ventbench.mechanics import identify

    if breaths.flow is None and breaths.volume is None:
        raise InputError(
            f"{path}: there is neither a column flow (mL/s) nor volume (mL); record one of them, "
            "or use `ventbench diagnose`, which needs the pressure only"
        )
    try:
        with bar(f"identifying the lungs of {path}") as identifying:
            return identify(breaths, identifying)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _lung(mechanics: Mechanics) -> dict[str, Any]:
    """Return JSON values; numbers that are not finite become null."""
    import dataclasses

    return files.json_values(dataclasses.asdict(mechanics) | {"settings": mechanics.match.settings})


def _term(term: Term) -> str:
    """A term with its parameters, and what explains nearly as much, in words."""
    values = [
        f"{name} {estimate.value:.3g} {estimate.unit} "
        f"[{estimate.ci95[0]:.3g}, {estimate.ci95[1]:.3g}]"
        for name, estimate in term.parameters.items()
    ]
    return f"{' or '.join((term.name, *term.alternatives))} ({', '.join(values)})"


def _table(lungs: dict[str, Mechanics]) -> Any:
    from ventbench.mechanics.labels import label_texts, tolerance_text, value_text

    columns = ("label", "R", "C", "label holds", "may be")
    rows = (
        (
            label,
            value_text(lung.match.fitted_R, lung.match.ci95_R),
            value_text(lung.match.fitted_C, lung.match.ci95_C),
            *label_texts(lung.match),
        )
        for label, lung in lungs.items()
    )
    return table_of(
        "Lungs from pressure and flow: R in cmH2O/(L/s) at 1 L/s, C in mL/cmH2O",
        columns,
        rows,
        left=columns,
        caption=f"Tolerance of a label beyond the intervals: {tolerance_text()}.",
    )


def diagnose(
    recordings: Annotated[
        Path,
        typer.Argument(
            help="CSV, CSV.GZ or Parquet file in the public schema, or the folder of a session, "
            "whose recordings are diagnosed as one. With --isolability a CSV file of planned "
            "breaths: u_in, u_out, time_step, breath_id."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            callback=claim_out,
            help="Folder for the results; always needed but with --isolability.",
        ),
    ] = None,
    simulator: SimulatorName = "physics",
    drive: Annotated[
        str,
        typer.Option(
            metavar="valve|flow",
            help="What the model follows: the recorded commands, or the recorded flow. By default "
            "the flow only if u_in is zero throughout.",
        ),
    ] = "auto",
    lung: Annotated[
        str | None,
        typer.Option(
            metavar="R20C50",
            help="Only the breaths of this lung; that of planned breaths, R20C50 by default.",
            autocompletion=complete_lungs,
        ),
    ] = None,
    patient: Annotated[
        bool,
        typer.Option(
            "--patient",
            help="A patient (or an active simulator) is ventilated and may breathe. Without this "
            "option the lung is a test lung, which makes no effort.",
        ),
    ] = False,
    clip: Clip = False,
    pad: Pad = False,
    missing: Missing = None,
    isolability: Annotated[
        bool,
        typer.Option(
            "--isolability",
            help="Tell which mechanisms planned breaths could tell apart, before anything is "
            "recorded.",
        ),
    ] = False,
    sensors: Annotated[
        str,
        typer.Option(metavar="pressure,flow", help="What is measured.", rich_help_panel=_PLANNED),
    ] = "pressure",
    noise: Annotated[
        float,
        typer.Option(help="Of pressure, standard deviation, cmH2O.", rich_help_panel=_PLANNED),
    ] = 0.25,
    names: Annotated[
        str,
        typer.Option(
            metavar="A,B",
            help="Only these mechanisms; the library if empty.",
            rich_help_panel=_PLANNED,
        ),
    ] = "",
    json: JsonFile = None,
) -> None:
    """Find the physics that a simulator lacks when it differs from a recording.

    Reports where they differ, which mechanisms are missing and with which parameters (or where in
    the model an effect outside the library acts), and how much the corrected simulator gains on
    held-out breaths. R, C, the expiratory resistance and PEEP are always refitted. Writes
    diagnosis.json, report.html, diagnosis.rrd and, if the simulator has plants, corrected.json,
    which every `--simulator` option accepts.

    Sampling rates from 20 to 1000 Hz are taken as they are. A simulator in plain Python is
    `--simulator module:function`; one in another program writes `--simulator answers.csv`, with
    breath_id, a column simulated (cmH2O) and perhaps time_step (s): perhaps the recording with that
    column.

    With --isolability, pairs of mechanisms that planned breaths would not tell apart are listed
    with the breath or the sensor that would; strengths are mild. The exit code is 1 if there are
    such pairs.

    Example: `ventbench diagnose recording.csv --lung R20C50 --out runs/diagnosis`

    Example: `ventbench diagnose plan.csv --isolability --sensors pressure,flow`
    """
    from ventbench.base import compilation
    from ventbench.diagnosis.diagnose import diagnose as find
    from ventbench.plants.catalog import load_simulators

    if isolability:
        return _isolability(recordings, lung or "R20C50", sensors, noise, names, json)
    if out is None:
        raise InputError("--out DIR is needed: the folder for the results")
    if drive not in ("auto", "valve", "flow"):
        raise InputError(f"--drive {drive}: choose auto, valve or flow")
    require("jinja2", "rerun")
    breaths = read_recording(recordings, clip=clip, pad=pad, missing=missing)
    compilation.keep()
    simulators = load_simulators(simulator)
    lungs = 1 if lung is not None else len(breaths.by_lung_index)
    notes().print(expected_time(len(breaths), lungs, compilation.is_warm()))
    with bar("diagnosing") as diagnosing:
        diagnosis = find(
            breaths,
            simulator=simulators,
            lung=lung,
            patient=patient,
            drive=drive,  # type: ignore[arg-type]
            progress=lambda stage, share: diagnosing(share, text=stage),
        )
    written = diagnosis.save(out)
    console = written_console(diagnosis.as_dict(), json)
    verdict, *sentences = str(diagnosis).splitlines()
    console.print(verdict, style="bold")
    for text in sentences:
        console.print(text)
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True)


def expected_time(breaths: int, lungs: int, warm: bool) -> str:
    """How long a diagnosis of some breaths usually takes, in words; ``warm``: once compiled."""
    usual = "10 s to a minute" if lungs == 1 else "one to five minutes"
    text = (
        f"diagnosing {breaths} breaths of {lungs} lung{'s' if lungs > 1 else ''}: usually {usual}"
    )
    if not warm:
        text += "; the first run on a machine compiles for half a minute more"
    return f"{text}. Ctrl-C stops it; nothing is written before the end."


def _isolability(
    controls: Path, lung: str, sensors: str, noise: float, names: str, json: Path | None
) -> None:
    """Print what planned breaths could tell apart; see :func:`diagnose`."""
    from ventbench.base import compilation
    from ventbench.diagnosis.isolability import isolability

    compilation.keep()
    result = isolability(
        controls,
        lung=lung,
        sensors=[sensor.strip() for sensor in sensors.split(",")],
        noise={"pressure": noise},
        names=[sensor for sensor in names.split(",") if sensor] or None,
    )
    console = written_console(result.as_dict(), json)
    for group in result.groups:
        apart = "told from all others" if len(group) == 1 else "not told apart"
        console.print(f"{', '.join(group)}: {apart}")
    nothing = "nothing that is known"
    rows = [
        (" / ".join(pair.names), f"{pair.nats:.1f}", pair.remedy or nothing, f"{pair.gained:.1f}")
        for pair in (*result.confused, *result.unseen)
    ]
    if rows:
        title = "What the plan does not tell apart, or not show at a mild strength"
        columns = ("mechanisms", "nats", "what would", "nats then")
        console.print(table_of(title, columns, rows, left=["what would"]))
    if result.confused:
        raise typer.Exit(1)
