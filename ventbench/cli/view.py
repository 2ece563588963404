"""``ventbench view`` and ``ventbench report``: pictures of scored runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from ventbench.trajectories import Trajectories

Runs = Annotated[
    list[Path],
    typer.Argument(
        metavar="RUN...",
        help="Folders that `ventbench score --out` wrote: the run to show, then references.",
    ),
]


def _read(folders: list[Path]) -> tuple[list[Trajectories], list[dict[str, Any]]]:
    import json

    from ventbench import trajectories
    from ventbench.base.errors import InputError

    runs, scores = [], []
    for folder in folders:
        kept = folder / "trajectories.npz"
        if not folder.is_dir():
            raise InputError(f"{folder}: there is no such folder")
        if not kept.is_file():
            raise InputError(
                f"{folder} contains no scored run; make one with "
                "`ventbench score SUBMISSION --out DIR` and give DIR/SUBMISSION"
            )
        runs.append(trajectories.load(kept))
        try:
            scores.append(json.loads((folder / "score.json").read_text("utf-8")))
        except (OSError, ValueError) as error:
            raise InputError(f"{folder / 'score.json'}: {error}; score the run again") from error
    return runs, scores


def view(
    runs: Runs,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File to write; default: scores.rrd in the first RUN."),
    ] = None,
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open the viewer.")] = True,
) -> None:
    """Write a rerun file of scored runs and open it.

    Example: `ventbench view runs/demo/pid_best runs/demo/pid_robust`
    """
    from ventbench import pages

    path = out or runs[0] / "scores.rrd"
    pages.write_rerun(path, _read(runs)[0])
    typer.echo(f"wrote {path}")
    if show:
        pages.open_viewer(path)


def report(
    runs: Runs,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File to write; default: report.html in the first RUN."),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write the panels as a PNG.")
    ] = None,
) -> None:
    """Write a self-contained HTML report of scored runs.

    Example: `ventbench report runs/demo/pid_best runs/demo/pid_robust`
    """
    from ventbench import pages

    loaded, scores = _read(runs)
    typer.echo(f"wrote {pages.write_report(out or runs[0] / 'report.html', loaded, scores)}")
    if figure is not None:
        typer.echo(f"wrote {pages.write_figure(figure, loaded)}")


COMMANDS = (view, report)
