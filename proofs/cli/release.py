"""``python -m proofs population``: what is run once for a release of the official simulators."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ventbench.cli.options import RecordingsDir, bar, recordings_folder


def population(
    simulators: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder that `ventbench train simulator` wrote."),
    ],
    recordings: RecordingsDir = None,
) -> None:
    """Fit the population of the rigs of simulators, from which draws take rigs of their own.

    Adds `population.npz` to the folder and tells in `population.toml` how the sessions lie in a
    population that was fitted without them.

    Example: `python -m proofs population runs/my-rig --recordings my-recordings`
    """
    from proofs.release.population import train_population

    folder = recordings_folder(recordings)
    with bar("fitting the population") as progress:
        train_population(folder, simulators, progress=progress)
    typer.echo(f"wrote {simulators / 'population.npz'}")
