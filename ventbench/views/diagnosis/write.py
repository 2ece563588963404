"""The two files that show a diagnosis; each is complete or absent, never half written."""

from __future__ import annotations

from pathlib import Path

from ventbench import extras, files
from ventbench.diagnosis.result import Diagnosis


def write_report(path: Path | str, found: Diagnosis) -> Path:
    """Write a self-contained HTML report: no script, no network.

    Args:
        path: target, ``.html`` by custom.
        found: what to show.

    Returns:
        The path; equal input gives equal bytes.

    Raises:
        InputError: if the extra is missing.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    extras.require("jinja2")
    from ventbench.views.diagnosis import report

    files.write_text(path, report.html(found))
    return path


def write_rerun(path: Path | str, found: Diagnosis) -> Path:
    """Write a rerun recording with its blueprint; as :func:`write_report`, ``.rrd`` by custom."""
    path = Path(path)
    extras.require("rerun")
    from ventbench.views.diagnosis import log

    content = log.recording(found)
    files.write_atomically(path, lambda file: file.write(content))
    return path
