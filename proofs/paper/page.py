"""The comparison with the paper as one page: its figures as pictures beside the numbers."""

from __future__ import annotations

import html
import io
from typing import Any

import numpy as np
from markdown_it import MarkdownIt

from proofs.paper.report import Chart, Reproduction
from ventbench.base.errors import require
from ventbench.palette import GREY, INK, LINE, QUIET, RUNS, SOFT

_HEAD = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>The paper, reproduced</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: {INK}; max-width: 60rem; margin: 2rem auto;
  padding: 0 1rem; }}
h2 {{ margin-top: 3rem; border-top: 1px solid {LINE}; padding-top: 1rem; }}
h2 + p em, figcaption {{ color: {QUIET}; font-size: 0.875rem; }}
figure {{ margin: 1rem 0; }}
figure svg {{ max-width: 100%; height: auto; }}
table {{ display: block; overflow-x: auto; border-collapse: collapse; font-size: 0.875rem;
  font-variant-numeric: tabular-nums; }}
th, td {{ padding: 0.25rem 0.75rem; text-align: right; border-bottom: 1px solid {LINE}; }}
th {{ background: {SOFT}; }}
th:first-child, td:first-child, table:first-of-type * {{ text-align: left; }}
</style></head><body>
"""


def page(reproduction: Reproduction) -> str:
    """The page as HTML, which needs no other file.

    Raises:
        InputError: if matplotlib is missing.
    """
    text = reproduction.to_markdown(_figure)
    return f"{_HEAD}{MarkdownIt().enable('table').render(text)}</body></html>\n"


def _figure(chart: Chart) -> str:
    """A chart with its caption as a block of HTML in Markdown, which ends at a blank line."""
    drawn = " ".join(svg(chart).split("\n"))
    return f"<figure>{drawn}<figcaption>{html.escape(chart.caption)}</figcaption></figure>"


def svg(chart: Chart) -> str:
    """A chart as SVG: curves, or groups of bars where the abscissae are names.

    Raises:
        InputError: if matplotlib is missing.
    """
    require("matplotlib")
    import matplotlib as mpl
    from matplotlib import rcsetup
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {
        "svg.hashsalt": chart.caption,  # equal figures give equal bytes
        "axes.prop_cycle": rcsetup.cycler(color=[*RUNS, GREY]),
        "axes.spines.top": False,
        "axes.spines.right": False,
        "font.size": 10,
    }
    with mpl.rc_context(style):
        figure = Figure(figsize=(8.0, 3.4), layout="constrained")
        axes = figure.add_subplot()
        for k, (name, (x, values)) in enumerate(chart.series.items()):
            y = np.array([np.nan if value is None else value for value in values], float)
            if isinstance(x[0], str):
                width = 0.8 / len(chart.series)
                at = np.arange(len(x)) + width * (k - 0.5 * (len(chart.series) - 1))
                axes.bar(at, y, width, label=name)
                axes.set_xticks(range(len(x)), [*map(str, x)], rotation=0 if len(x) < 9 else 90)
            else:
                dashes = "--" if name == "target" else "-"
                axes.plot(np.asarray(x, float), y, dashes, label=name, linewidth=1.5)
        axes.set_xlabel(chart.x)
        axes.set_ylabel(chart.y)
        if len(chart.series) > 1:
            figure.legend(loc="outside right upper", frameon=False)
        output = io.StringIO()
        figure.savefig(output, format="svg", metadata={"Date": None, "Creator": None})
    text = output.getvalue()
    return text[text.index("<svg") :]
