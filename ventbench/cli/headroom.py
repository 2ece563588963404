"""``ventbench headroom``: what normalised scores are measured against."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

from ventbench.cli.options import JsonFile, Scheduler, Workers, bars, emit

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

    Commands are optimised for each cell with everything known; the best PID of a lung comes from
    the paper's grid on all rigs of the lung. Takes minutes; the same command continues.

    Example: `ventbench headroom --check data/bounds-v2.npz`
    """
    import numpy as np
    from rich.console import Console

    from ventbench.base.executor import executor
    from ventbench.entries import reference as references
    from ventbench.plants.rigs import load_rigs
    from ventbench.task import draws, protocol
    from ventbench.train import pid_grid

    console = Console(stderr=str(json) == "-")
    rigs = load_rigs()
    drawn = rigs.draws(draws.COUNT)
    plants, cells = rigs.cells(drawn, protocol.PIPS)
    about = references.settings(rigs.about, drawn.about())
    if check is not None:
        computed = references.load(check)
        references.reference_of(rigs.about, drawn.about(), computed)
        result = references.checked(computed, plants, cells, every=_EVERY)
        emit(result, json)
        for key, value in result.items():
            console.print(f"{key}: {value}", highlight=False)
        if not result["sound"]:
            raise typer.Exit(1)
        return
    parts = out.with_suffix(".parts")
    with bars() as progress:
        task = progress.add_task("best PID of each lung", total=None)
        gains, _ = pid_grid.best_pids(
            rigs, progress=lambda done, all_: progress.update(task, completed=done, total=all_)
        )
        task = progress.add_task("best attainable", total=None)
        with executor(workers, scheduler) as pool:
            computed = references.compute(
                plants,
                cells,
                gains,
                about,
                folder=parts,
                pool=pool,
                progress=lambda done, all_: progress.update(task, completed=done, total=all_),
            )
    sha256 = computed.save(out)
    shutil.rmtree(parts)  # they are in the file now
    summary = {
        "file": str(out),
        "sha256": sha256,
        "gains": computed.gains.tolist(),
        "attainable": float(computed.attainable.mean()),
        "lower": float(computed.lower.mean()),
        "pid": float(computed.pid.mean()),
        "largest_gap": float(np.max(computed.attainable - computed.lower)),
    }
    emit(summary, json)
    console.print(
        f"wrote {out}\nmean over cells, first step left out: best attainable "
        f"{summary['attainable']:.3f} cmH2O (at least {summary['lower']:.3f}), best PID "
        f"{summary['pid']:.3f}\nSHA-256 {sha256}",
        highlight=False,
        soft_wrap=True,
    )


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(headroom)
