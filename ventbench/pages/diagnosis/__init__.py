"""Pictures of a diagnosis: HTML report, rerun file and figure (extra ``ventbench[view]``)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ventbench.base import errors, files

if TYPE_CHECKING:
    from ventbench.diagnosis.result import Diagnosis

__all__ = ["write_report", "write_rerun"]


def write_report(path: Path | str, diagnosis: Diagnosis) -> Path:
    """Write a self-contained HTML report, ``.html`` by custom, and return the path.

    It has no script and no network; equal input gives equal bytes.

    Raises:
        InputError: if the extra is missing.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    errors.require("jinja2")
    from ventbench.pages.diagnosis import report

    files.write_text(path, report.html(diagnosis))
    return path


def write_rerun(path: Path | str, diagnosis: Diagnosis) -> Path:
    """Write a rerun recording with its blueprint, ``.rrd`` by custom, and return the path.

    Raises:
        InputError: if the extra is missing, or rerun is switched off.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    errors.require("rerun")
    from ventbench.pages.diagnosis import rerun_log

    content = rerun_log.recording(diagnosis)
    files.write_atomically(path, lambda file: file.write(content))
    return path
