"""``ventbench lungs``, ``ventbench simulate``: the simulators by themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ventbench.cli.options import JsonFile, emit
