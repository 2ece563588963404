"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def claim_out(folder: Path | None) -> Path | None:
    """Check a folder of results before anything is computed; see ``files.claim_folder``."""
    from ventbench import files

    if folder is not None:
        files.claim_folder(folder)
    return folder


JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Also write the result as JSON; '-' for stdout."),
]
Clip = Annotated[
    bool, typer.Option("--clip", help="Clip u_in to 0..100 % instead of refusing the file.")
]
Pad = Annotated[bool, typer.Option("--pad", help="Accept breaths of unequal length.")]
PlantName = Annotated[
    str,
    typer.Option(
        "--plant",
        metavar="PLANT",
        help="Simulators: frozen (the official ones), learned, physics, two_balloon, a file of "
        "plants such as corrected.json, a CSV or Parquet file of simulated pressures, or "
        "module:function.",
    ),
]
ResultsPage = Annotated[
    Path | None,
    typer.Option(
        "--page",
        metavar="FILE",
        help="Markdown file whose section of these results is written anew; made if missing.",
    ),
]
RecordingsDir = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", help="Folder of the public recordings; VENTBENCH_RECORDINGS by default."
    ),
]


def recordings_folder(given: Path | None) -> Path:
    """Return the folder of the public recordings.

    Raises:
        InputError: if there is none.
    """
    from ventbench.errors import InputError
    from ventbench.recordings import recordings_dir

    folder = given or recordings_dir()
    if folder is None or not folder.is_dir():
        raise InputError(
            f"{folder or 'no folder'} contains no recordings; give --recordings DIR or set "
            "VENTBENCH_RECORDINGS"
        )
    return folder


def emit(value: object, target: Path | None) -> None:
    """Write the result of a command to the file of ``--json``, atomically."""
    from ventbench import files

    if target is None:
        return
    if str(target) == "-":
        print(files.as_json(value), end="")
    else:
        files.write_json(target, value)


def bars() -> Any:
    """Return progress bars on stderr that show the finished share and the remaining time."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    return Progress(*columns, transient=True, console=Console(stderr=True))
