"""The command line ``python -m proofs``: parses, calls, prints, as :mod:`ventbench.cli` does."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ResultsPage = Annotated[
    Path | None,
    typer.Option(
        "--page",
        metavar="FILE",
        help="Markdown file whose section of these results is written anew; made if missing.",
    ),
]
