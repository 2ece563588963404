"""The three files that show a run; each is complete or absent, never half written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ventbench import extras, files
from ventbench.trajectories import Trajectories
from ventbench.views.runs import check


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
    extras.require("rerun")
    from ventbench.views import rerun_log

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
    extras.require("jinja2")
    from ventbench.views import report

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
    extras.require("matplotlib")
    from ventbench.views import figure

    content = figure.png(runs)
    files.write_atomically(path, lambda file: file.write(content))
    return path
