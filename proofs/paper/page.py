"""The page of a reproduction: one HTML file, no script, nothing from the network."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

import ventbench
from proofs.paper.report import Chart, Reproduction
from ventbench import palette
from ventbench.base import files
from ventbench.base.errors import require
from ventbench.pages.diagnosis.charts import Chart as Axes

#: Size of a chart, px.
WIDTH, HEIGHT = 640.0, 280.0


def write_reproduction(path: Path | str, reproduction: Reproduction) -> Path:
    """Write the page.

    Args:
        path: target, ``.html`` by custom.
        reproduction: what :func:`proofs.paper.paper.reproduce_paper` returned.

    Returns:
        The path; equal input gives equal bytes.

    Raises:
        InputError: if the extra is missing.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    require("jinja2")
    files.write_text(path, html(reproduction))
    return path


def html(reproduction: Reproduction) -> str:
    """Return the page; see :func:`write_reproduction`."""
    from ventbench.base.text import page_templates

    # From a string, so that the style sheet of reports is found.
    source = Path(__file__).with_name("page.html.j2").read_text("utf-8")
    page = page_templates("ventbench.pages").from_string(source)
    return page.render(
        about=reproduction.about,
        summary=reproduction.summary(),
        sections=[
            (section, [(chart, _axes(chart)) for chart in section.charts])
            for section in reproduction.sections
        ],
        not_reproduced=reproduction.not_reproduced,
        colors=palette.css(),
        run_colors=palette.RUNS,
        # What the style sheet of reports asks for besides.
        shades=(),
        pips=range(3),
        names=(),
        version=ventbench.__version__,
    )


def _axes(chart: Chart) -> Axes:
    """Axes of a chart with its lines, in their order."""
    values = np.array([v for line in chart.lines for v in line.y if math.isfinite(v)])
    ends = np.array([x for line in chart.lines for x in line.x])
    low, high = min(float(values.min()), 0.0), float(values.max())
    axes = Axes(
        (float(ends.min()), float(ends.max())), (low, high + 0.05 * (high - low)), chart.x_label,
        chart.y_label, chart.title, WIDTH, HEIGHT, log=chart.logarithmic,
    )  # fmt: skip
    for line in chart.lines:
        axes.line("dash" if line.dashed else "", line.x, line.y)
    return axes
