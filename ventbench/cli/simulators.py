"""What simulators are, what they answer, how far from recordings, and pictures of scored runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.base.text import number
from ventbench.cli.options import (
    Clip,
    JsonFile,
    Pad,
    SimulatorName,
    bar,
    complete_lungs,
    read_recording,
    table_of,
    written_console,
)
from ventbench.task import protocol


def lungs(json: JsonFile = None) -> None:
    """List the six lungs and the errors of their simulators on recorded breaths held out.

    There are three errors a lung, mean / median |simulated - recorded| pressure in cmH2O: of the
    rigs that are scored on their own breaths, of the lung on breaths of rigs that the fit has not
    seen, and of all breaths that bear the label, each by the rig of its clock.

    Example: `ventbench list lungs`
    """
    from ventbench.plants import frozen

    published = frozen.load()
    summaries = published.lungs()
    kinds = {"own_rig": "own rig", "unseen_rig": "unseen rig", "held_out": "by clock"}

    def shown(summary: dict[str, Any], kind: str) -> str:
        return f"{summary[f'{kind}_mae']:.2f} / {summary[f'{kind}_median_mae']:.2f}"

    rows = []
    for rigs, (lung_id, summary) in zip(published.rigs, summaries.items(), strict=True):
        setting = (f"{summary['R']:g}", f"{summary['C']:g}", str(len(rigs)))
        figures = (shown(summary, kind) for kind in kinds)
        rows.append((lung_id, *setting, *figures, str(summary["held_out_breaths"])))
    table = table_of(
        "The six lungs: error of their simulators on breaths held out, cmH2O",
        ("lung", "R", "C", "rigs", *kinds.values(), "breaths"),
        rows,
        no_wrap=True,
        caption="Mean / median. R in cmH2O/(L/s), C in mL/cmH2O.",
    )
    console = written_console(summaries, json)
    console.print(table)
    for session, reason in published.rejected.items():
        label = published.sessions.table[session].lung
        if label in summaries:
            text = f"not scored: session {session} of {label}: {reason}"
            console.print(text, soft_wrap=True)


def simulate(
    controls: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="CSV in UTF-8 with u_in in %; optionally u_out (0 or 1) and time_step in s; of "
            "many breaths also breath_id, and R and C if --lung is not given.",
        ),
    ],
    lung: Annotated[
        str | None, typer.Option(help="Lung, such as R20C50.", autocompletion=complete_lungs)
    ] = None,
    start: Annotated[
        float, typer.Option(min=0.0, max=60.0, help="Pressure at the first sample, cmH2O.")
    ] = protocol.PEEP,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write to this file instead of stdout; of many breaths also .csv.gz or .parquet.",
        ),
    ] = None,
    simulator: SimulatorName = "frozen",
) -> None:
    """Simulate the pressures for a file of valve commands, as CSV.

    A file with a column breath_id holds many breaths; what is written is then a recording in the
    public schema.

    Example: `ventbench simulate --lung R20C50 --controls commands.csv`
    """
    from ventbench import recordings, simulation

    with open(controls, encoding="utf-8-sig", errors="replace") as file:
        many = "breath_id" in file.readline().replace('"', "").strip().split(",")
    if many:
        simulated = simulation.simulate_breaths(
            controls, lung=lung, simulator=simulator, start=start
        )
        if out is None:
            typer.echo(simulated.to_frame().to_csv(index=False), nl=False)
        else:
            recordings.write(simulated, out)
        return
    if lung is None:
        raise InputError("--lung is needed: the file names no lung; give one such as R20C50")
    text = simulation.simulate(controls, lung=lung, simulator=simulator, start=start).to_csv()
    if out is None:
        typer.echo(text, nl=False)
    else:
        files.write_text(out, text)


def open_loop(
    recordings: Annotated[
        Path, typer.Argument(help="CSV, CSV.GZ or Parquet file in the public schema.")
    ],
    simulator: SimulatorName = "frozen",
    clip: Clip = False,
    pad: Pad = False,
    json: JsonFile = None,
) -> None:
    """Measure the error of simulators on recorded breaths under the recorded commands.

    The error of a breath is the mean |simulated - recorded| pressure over its inspiratory samples,
    cmH2O; the simulation starts at the first recorded pressure. For held-out errors, a member of
    the ensemble that was not trained on a breath simulates it.

    Example: `ventbench data open-loop recording.csv --json errors.json`
    """
    import numpy as np

    from ventbench import simulation

    breaths = read_recording(recordings, clip=clip, pad=pad)
    if not np.isfinite(breaths.pressure).any():
        raise InputError(
            f"{recordings}: all pressures are blank; fill them in: there is nothing to compare a "
            "simulator with"
        )
    with bar(f"simulating {len(breaths)} breaths") as simulating:
        result = simulation.open_loop(breaths, simulator, progress=simulating)
    console = written_console(result.as_dict(), json)
    console.print(_open_loop_table(result.as_dict()))
    for line in result.remarks():
        console.print(line)


def _open_loop_table(result: dict[str, Any]) -> Any:
    rows = [
        (
            lung,
            str(figures["breaths"]),
            number(figures["mae"]),
            number(figures["median_mae"]),
            number(figures["held_out_mae"]),
            "..".join(map(number, figures["held_out_ci95"])),
            number(figures["held_out_median_mae"]),
        )
        for lung, figures in result["lungs"].items()
    ]
    title = f"Open-loop MAE of the {result['plant']} simulators, cmH2O"
    columns = ("lung", "n", "mean", "median", "held-out", "95 %", "median")
    return table_of(title, columns, rows, no_wrap=True)


Runs = Annotated[
    list[Path],
    typer.Argument(
        metavar="RUN...",
        help="Folders that `ventbench score --out` wrote: the run to show, then references.",
    ),
]


def view(
    runs: Runs,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File to write: a rerun file, or a report if it ends with .html; default: "
            "scores.rrd in the first RUN.",
        ),
    ] = None,
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open a rerun file.")] = True,
) -> None:
    """Write a rerun file of scored runs and open it, or write a self-contained HTML report.

    Example: `ventbench view runs/demo/pid_best runs/demo/pid_robust --out report.html`
    """
    import json

    from ventbench import pages, trajectories

    loaded, scores = [], []
    for folder in runs:
        saved = folder / "trajectories.npz"
        if not saved.is_file():
            raise InputError(
                f"{folder} contains no scored run; make one with "
                "`ventbench score SUBMISSION --out DIR` and give DIR/SUBMISSION"
            )
        loaded.append(trajectories.load(saved))
        try:
            scores.append(json.loads((folder / "score.json").read_text("utf-8")))
        except (OSError, ValueError) as error:
            raise InputError(f"{folder / 'score.json'}: {error}; score the run again") from error
    path = out or runs[0] / "scores.rrd"
    if is_report := path.suffix == ".html":
        pages.write_report(path, loaded, scores)
    else:
        pages.write_rerun(path, loaded)
    typer.echo(f"wrote {path}")
    if show and not is_report:
        pages.open_viewer(path)
