"""The command line ``python -m proofs``: parses, calls, prints, as :mod:`ventbench.cli` does."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

ResultsPage = Annotated[
    Path | None,
    typer.Option(
        "--page",
        metavar="FILE",
        help="Markdown file whose section of these results is written anew; made if missing.",
    ),
]


def tabulated(
    title: str, heads: Iterable[str], rows: Iterable[Iterable[str]], *, left: Iterable[int] = (0,),
    caption: str | None = None,
) -> Any:  # fmt: skip
    """A table for the terminal; columns are aligned to the right but for those named ``left``."""
    from rich.table import Table

    made, at = Table(title=title, caption=caption), set(left)
    for k, head in enumerate(heads):
        made.add_column(head, justify="left" if k in at else "right", no_wrap=k == 0)
    for row in rows:
        made.add_row(*row)
    return made
