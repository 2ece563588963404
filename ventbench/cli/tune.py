"""``ventbench tune``, ``headroom``, ``stressors``, ``adversary``: searches for gains and limits.

Best gains of a PID, the bounds of any controller, and how little missing physics is too much.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from ventbench.base import files
from ventbench.base.errors import InputError
from ventbench.cli.options import (
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
    known_lungs,
    table_of,
    told,
    waiting,
)

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

    Example: `ventbench headroom --check data/bounds-v2.npz`
    """
    import numpy as np

    from ventbench.base.executor import executor
    from ventbench.entries import reference as references
    from ventbench.plants.rigs import load_rigs
    from ventbench.task import draws, protocol
    from ventbench.train.best_pid import best_pids

    rigs = load_rigs()
    drawn = rigs.draws(draws.COUNT)
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    about = references.settings(rigs.about, drawn.about())
    if check is not None:
        computed = references.load(check)
        references.reference_of(rigs.about, drawn.about(), computed)
        result = references.checked(computed, plants, cells, every=_EVERY)
        console = told(result, json)
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
            plants, cells, pids.gains, about, folder=parts, pool=pool, progress=progress
        )
    sha256 = computed.save(out)
    shutil.rmtree(parts)  # they are in the file now
    summary = {
        "file": str(out),
        "sha256": sha256,
        "gains": computed.gains.tolist(),
        "searches": pids.search_gains.tolist(),
        "search_errors": pids.search_errors.tolist(),
        "searches_agree": pids.agree.tolist(),
        "distance": np.round(computed.attainable - computed.lower, 6).tolist(),
        "attainable": float(computed.attainable.mean()),
        "lower": float(computed.lower.mean()),
        "pid": float(computed.pid.mean()),
        "largest_gap": float(np.max(computed.attainable - computed.lower)),
    }
    told(summary, json).print(
        f"wrote {out}\nmean over cells, first step left out: best attainable "
        f"{summary['attainable']:.3f} cmH2O (at least {summary['lower']:.3f}), best PID "
        f"{summary['pid']:.3f}\nSHA-256 {sha256}",
        soft_wrap=True,
    )


app = typer.Typer(name="tune", help="Search for the gains of a controller.", no_args_is_help=True)

PLOT = "grid.png"


@app.callback()
def _group() -> None:
    pass


@app.command()
def pid(
    lung: Annotated[
        str | None,
        typer.Option(
            metavar="LUNG", help="Only this lung, such as R20C50.", autocompletion=known_lungs
        ),
    ] = None,
    every: Annotated[
        bool,
        typer.Option(
            "--all", help="All six lungs: the best gains of each, and the best single set."
        ),
    ] = False,
    robust: Annotated[
        bool, typer.Option("--robust", help="All six lungs: only the best single set.")
    ] = False,
    out: Annotated[
        Path,
        typer.Option(metavar="DIR", callback=claim_out, help="Folder for table, plot and result."),
    ] = Path("runs/pid"),
    plant: PlantName = "frozen",
    draws: Annotated[
        int,
        typer.Option(
            min=0,
            max=20,
            help="Draws with noise and deviations that decide among the 100 best; 0 to decide "
            "without noise, as in the paper.",
        ),
    ] = 20,
    beyond: Annotated[
        bool,
        typer.Option("--beyond", help="Search on draws without the grid: gains have no edge."),
    ] = False,
    json: JsonFile = None,
) -> None:
    """Simulate the paper's 8,000 PIDs at six PIPs on the frozen simulators or others.

    P, I and D each take the values 0, 0.1, ..., 0.9, 1, 2, ..., 10 %/cmH2O. On the frozen
    simulators a lung has all its rigs but the held-out one. The 100 best without noise also run on
    draws that are for tuning alone, and the best there win.

    Example: `ventbench tune pid --all --out runs/pid`
    """
    from ventbench.train.best_pid import tune_beyond
    from ventbench.train.pid_grid import RESULT, TABLE, tune_pid

    if (lung is not None) + every + robust != 1:
        raise InputError("give exactly one of --lung LUNG, --all and --robust")
    names = None if lung is None else (lung,)
    with bar("PIDs") as progress:
        if beyond:
            result = tune_beyond(
                names, draws=draws, each=not robust, single=lung is None, simulator=plant,
                progress=progress,
            )  # fmt: skip
            files.write_json(out / RESULT, result)
            written = [RESULT]
        else:
            grid, result = tune_pid(
                names, out, draws=draws, each=not robust, simulator=plant, progress=progress
            )
            written = [TABLE, RESULT, *_plot(out / PLOT, grid, not robust, lung is None)]
    console = told(result, json)
    console.print(_table(result))
    for name in written:
        console.print(f"wrote {out / name}", soft_wrap=True)


def _plot(path: Path, grid: Any, each: bool, single: bool) -> list[str]:
    """Draw the picture if matplotlib is installed."""
    from ventbench.pages.report import gain_map_png

    try:
        picture = gain_map_png(grid, each=each, single=single)
    except InputError as error:
        typer.echo(f"no plot: {error}", err=True)
        return []
    files.write_bytes(path, picture)
    return [path.name]


def _table(result: dict[str, Any]) -> Any:
    def row(name: str, entry: dict[str, Any]) -> tuple[str, ...]:
        return name, *(f"{gain:g}" for gain in entry["gains"]), f"{entry['error']:.3f}"

    rows = (row(name, entry) for name, entry in result.get("lungs", {}).items())
    title = "Best PID gains; mean |pressure - target|, cmH2O"
    table = table_of(title, ("lung", "P", "I", "D", "error"), rows)
    if "single" in result:
        table.add_section()
        table.add_row(*row("all six", result["single"]), style="bold")
    return table


def stressors(json: JsonFile = None) -> None:
    """List the stressors, which are missing physics, and their strengths.

    Example: `ventbench stressors`
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
    console = told({"version": VERSION, "stressors": lines, "pairs": pairs}, json)
    console.print(table_of(f"Stressors, version {VERSION}", columns, rows, left=columns[:4]))
    console.print("Pairs, both mild: " + ", ".join(" + ".join(pair) for pair in PAIRS))


def adversary(
    name: Annotated[
        str,
        typer.Argument(
            metavar="SUBMISSION",
            help="Folder or name of a bundled submission.",
            autocompletion=known_entries,
        ),
    ],
    lung: Annotated[
        list[str] | None,
        typer.Option(
            help="Lung to search on; may be repeated. Default: all.", autocompletion=known_lungs
        ),
    ] = None,
    stressor: Annotated[
        list[str] | None,
        typer.Option(help="Stressor that may act; may be repeated. Default: all, and the rig."),
    ] = None,
    track: OneTrack = None,
    plant: PlantName = "frozen",
    in_process: InProcess = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", callback=claim_out, help="Write adversary.json and adversary.txt here."
        ),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Search for the mildest plausible physics that makes a controller unsafe.

    Severity 0 is the rig in the middle of the population, 1 the end of the range: a stressor at its
    strong strength, or a rig three standard deviations away; what acts together adds as squares.
    The exit code is 1 if something unsafe was found.

    Example: `ventbench adversary pid_robust --lung R5C10`
    """
    from dataclasses import asdict

    from ventbench.base import compilation
    from ventbench.entries.adversary import adversary as search

    compilation.keep()
    with waiting(f"searching for what makes {name} unsafe"):
        found = search(
            name, simulator=plant, track=track, lungs=lung or (), stressors=stressor or (),
            sandbox=not in_process,
        )  # fmt: skip
    values = {"submission": name, "lungs": [asdict(one) for one in found]}
    text = "\n".join(line for one in found for line in one.lines())
    emit(values, json)
    typer.echo(text, err=str(json) == "-")
    if out is not None:
        files.write_json(out / "adversary.json", values)
        files.write_text(out / "adversary.txt", text + "\n")
    if any(one.severity is not None for one in found):
        raise typer.Exit(1)


COMMANDS = (headroom, stressors, adversary)
