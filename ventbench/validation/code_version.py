"""The code that measured something: results name it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import ventbench


def code_version() -> str:
    """Commit of the checkout that this package runs from, or else its version."""
    folder = Path(ventbench.__file__).parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return ventbench.__version__
    return done.stdout.strip() or ventbench.__version__
