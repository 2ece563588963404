"""The text beside the plots in the rerun viewer."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

import ventbench
from ventbench import protocol
from ventbench.text import number
from ventbench.trajectories import Trajectories
from ventbench.views.runs import errors

#: Longest name over a column of the table, characters.
COLUMN = 16


def markdown(runs: Sequence[Trajectories], names: Sequence[str]) -> str:
    """Say what is seen and how the runs scored.

    Args:
        runs: matching runs, the one to look at first.
        names: their labels; they are strangers' text and are escaped here.
    """
    plain, names = names, [escape(name) for name in names]
    first, last = min(protocol.SCORED_BREATHS) + 1, max(protocol.SCORED_BREATHS) + 1
    track = runs[0].track if runs[0].track in ("performance", "robustness") else "unknown"
    breath = protocol.BREATH_STEPS * protocol.DT
    compared = f"- **thin lines** in a lung's tab: {', '.join(names[1:])}\n" if names[1:] else ""
    lines = [
        f"# {names[0]}",
        "",
        f"{track} track, protocol {protocol.VERSION}",
        "",
        "## Score, cmH2O",
        "",
        *_table(runs, plain),
        "",
        f"Mean absolute error, abs(pressure - target), over the inspirations of breaths {first} "
        f"and {last}, without noise. Lower is better.",
        "",
        "## What you see",
        "",
        f"- **one colour a PIP**, {min(runs[0].pips):g} to {max(runs[0].pips):g} cmH2O",
        "- **thin grey**: target",
        f"{compared}- **green bar** at the bottom: scored part",
        "",
        f"**All lungs**: one plot a lung, breath {last}. "
        "R is resistance, cmH2O/(L/s); C compliance, mL/cmH2O.",
        "",
        f"**A lung's tab**: the whole run, {protocol.BREATHS} breaths of {breath:g} s, with "
        "pressure, valves and error above each other.",
        "",
        "The time axis is seconds since the run began. Hover to read values, drag to move, "
        "Ctrl + scroll to zoom, double-click to reset, click a legend entry to hide it.",
        "",
        f"ventbench {ventbench.__version__}",
    ]
    return "\n".join(lines) + "\n"


def escape(text: str) -> str:
    """Make text plain in Markdown: no link, image, table or heading can come from it."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(text.split()))


def _table(runs: Sequence[Trajectories], names: Sequence[str]) -> list[str]:
    """Lungs by runs, the best of each lung in bold."""
    scores = np.stack([errors(run).mean(axis=1) for run in runs], axis=1)
    rows = [*zip(runs[0].lungs, scores, strict=True), ("mean", scores.mean(axis=0))]
    heads = [escape(name if len(name) <= COLUMN else name[: COLUMN - 2] + "..") for name in names]
    lines = ["| lung | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(names)]
    for lung, row in rows:
        best = np.nanmin(row) if np.isfinite(row).any() else np.nan
        cells = [f"**{number(x)}**" if x == best and len(row) > 1 else number(x) for x in row]
        lines.append(f"| {lung} | " + " | ".join(cells) + " |")
    return lines
