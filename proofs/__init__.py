"""Proofs that ventbench does what it says: run from a checkout, no part of the package.

``python -m proofs COMMAND``: challenges with concealed effects, the diagnosis on the real rig and
on pairs of real recordings, the paper's tables and figures beside ours, studies of what trains.
"""

from __future__ import annotations

import subprocess
from importlib.metadata import version
from pathlib import Path


def code_version() -> str:
    """Commit of the checkout that this package runs from, or else its version."""
    folder = Path(__file__).parent
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return version("ventbench")
    return done.stdout.strip() or version("ventbench")
