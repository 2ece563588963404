"""The page of a reproduction: one HTML file, no script, nothing from the network."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from proofs.paper.report import Chart, Reproduction
from ventbench import palette
from ventbench.base import files
from ventbench.base.errors import require
from ventbench.pages import panels

#: Size of a chart and of its plot: left, top, right and bottom margins.
WIDTH, HEIGHT = 640.0, 280.0
LEFT, TOP, RIGHT, BOTTOM = 44.0, 18.0, 8.0, 34.0


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
            (section, [_chart(chart) for chart in section.charts])
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


def _chart(chart: Chart) -> dict[str, Any]:
    """Lines, ticks and labels of a chart, in pixels."""
    values = np.array([v for line in chart.lines for v in line.y if math.isfinite(v)])
    ends = np.array([x for line in chart.lines for x in line.x])
    low, high = min(float(values.min()), 0.0), float(values.max())
    high += 0.05 * (high - low)

    def across(x: Any) -> Any:
        first, last = float(ends.min()), float(ends.max())
        if chart.logarithmic:
            x, first, last = np.log(x), math.log(first), math.log(last)
        share = (np.asarray(x, float) - first) / max(last - first, 1e-9)
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def up(y: Any) -> Any:
        share = (np.asarray(y, float) - low) / (high - low)
        return HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)

    marks: Any
    if chart.logarithmic:
        marks = 10.0 ** np.arange(math.ceil(math.log10(ends.min())), math.log10(ends.max()) + 0.01)
    else:
        marks = _ticks(float(ends.min()), float(ends.max()))
    return {
        "title": chart.title,
        "x_label": chart.x_label,
        "y_label": chart.y_label,
        "lines": [
            {
                "name": line.name,
                "path": panels.path(np.stack([across(line.x), up(line.y)], axis=-1)),
                "dashed": line.dashed,
            }
            for line in chart.lines
        ],
        "x": [(f"{mark:g}", round(float(across(mark)), 1)) for mark in marks],
        "y": [(f"{mark:g}", round(float(up(mark)), 1)) for mark in _ticks(low, high)],
        "width": WIDTH, "height": HEIGHT, "left": LEFT, "right": WIDTH - RIGHT,
        "top": TOP, "bottom": HEIGHT - BOTTOM,
    }  # fmt: skip


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from low to high, about five."""
    raw = (high - low) / 5.0
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw)
    return [round(k * step, 10) for k in range(math.ceil(low / step), int(high / step + 1e-9) + 1)]
