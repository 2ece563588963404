"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Also write the result as JSON; '-' for stdout."),
]
Clip = Annotated[bool, typer.Option("--clip", help="Bring u_in into 0..100 % instead of refusing.")]
Pad = Annotated[bool, typer.Option("--pad", help="Accept breaths of unequal length.")]


def emit(value: object, target: Path | None) -> None:
    """Write a command's result where ``--json`` says, in one step."""
    from ventbench import files

    if target is None:
        return
    if str(target) == "-":
        print(files.as_json(value), end="")
    else:
        files.write_json(target, value)
