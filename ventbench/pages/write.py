"""The three files that show a run, and the viewer of one; no file is ever half written."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ventbench.base import errors, files
from ventbench.pages.runs import check
from ventbench.trajectories import Trajectories


def write_rerun(path: Path | str, runs: Sequence[Trajectories]) -> Path:
    """Write a rerun recording with its blueprint.

    Args:
        path: target, ``.rrd`` by custom.
        runs: the run to look at, then references to compare it with (such as the PID).

    Returns:
        The path.

    Raises:
        InputError: if there is no run, the runs do not match, or the extra is missing.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    check(runs)
    errors.require("rerun")
    from ventbench.pages import rerun_log

    content = rerun_log.recording(runs)
    files.write_atomically(path, lambda file: file.write(content))
    return path


def write_report(
    path: Path | str,
    runs: Sequence[Trajectories],
    scores: Sequence[Mapping[str, Any]] | None = None,
) -> Path:
    """Write a self-contained HTML report: no script, no network.

    Args:
        path: target, ``.html`` by custom.
        runs: the run to look at, then references; differences are to the first reference.
        scores: what ``ventbench score --json`` wrote for each run, in the same order: the table
            then shows these scores, and the provenance all that they say. Without them the table
            shows the mean absolute error of the runs themselves.

    Returns:
        The path; equal input gives equal bytes.

    Raises:
        InputError: if there is no run, the runs do not match, the scores do not belong to them, or
            the extra is missing.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    check(runs)
    errors.require("jinja2")
    from ventbench.pages import report

    files.write_text(path, report.html(runs, scores))
    return path


def write_figure(path: Path | str, runs: Sequence[Trajectories]) -> Path:
    """Write the small multiples as a PNG, 1800 pixels wide.

    Args:
        path: target, ``.png`` by custom.
        runs: the run to look at, then references.

    Returns:
        The path.

    Raises:
        InputError: if there is no run, the runs do not match, or the extra is missing.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    check(runs)
    errors.require("matplotlib")
    from ventbench.pages import figure

    content = figure.png(runs)
    files.write_atomically(path, lambda file: file.write(content))
    return path


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def open_viewer(path: Path | str) -> bool:
    """Open a rerun file in the viewer, which outlives this process.

    Args:
        path: path of the ``.rrd`` file.

    Returns:
        Whether a viewer was started; if not, how to open the file was printed.

    Raises:
        InputError: if the extra is missing.
        OSError: if the file is not there.
    """
    path = Path(path)
    path.open("rb").close()
    errors.require("rerun")
    if not has_display():
        print(
            f"No display here. Open the file where there is one: rerun {path}\n"
            f"or from this machine in a browser: rerun --web-viewer {path}"
        )
        return False
    subprocess.Popen(
        [sys.executable, "-m", "rerun", str(path)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    return True
