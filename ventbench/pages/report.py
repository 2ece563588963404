"""Files that show runs, an HTML report without script or network and the viewer's; maps of gain."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import ventbench
from ventbench import palette
from ventbench.base import errors, files
from ventbench.base.arrays import Floats
from ventbench.base.text import number, page_templates
from ventbench.pages import panels
from ventbench.pages.panels import check, labels, shared_tracks
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung
from ventbench.trajectories import Trajectories

if TYPE_CHECKING:
    from ventbench.train.pid_search import PIDGrid


def write_rerun(path: Path | str, runs: Sequence[Trajectories]) -> Path:
    """Write a rerun recording with its blueprint, ``.rrd`` by custom; see :func:`write_report`."""
    check(runs)
    errors.require("rerun")
    from ventbench.pages import rerun_log

    return _write(path, rerun_log.recording(runs))


def _write(path: Path | str, content: bytes) -> Path:
    files.write_bytes(Path(path), content)
    return Path(path)


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
    check(runs)
    errors.require("jinja2")
    return _write(path, html(runs, scores).encode())


def has_display() -> bool:
    """Whether a window can be opened here."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def open_viewer(path: Path | str) -> bool:
    """Open a rerun file in the viewer, which outlives this process; say whether that was possible.

    If not, how to open the file was printed.

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


#: Limits between the shades of differences, cmH2O, and how much colour each shade has, %.
SHADE_LIMITS, SHADES = (0.02, 0.2, 0.7, 2.0), (12, 24, 38, 55)


def html(runs: Sequence[Trajectories], scores: Sequence[Mapping[str, Any]] | None = None) -> str:
    """Return the page of matching runs, the one to look at first; differences are to the second.

    Raises:
        InputError: if the score files do not belong to the runs.
    """
    names = labels(runs)
    numbers = panels.collect(runs, scores)
    page = page_templates("ventbench.pages").get_template("report.html.j2")
    return page.render(
        title=names[0],
        names=names,
        classes=[f"r{palette.run_index(i)}" for i in range(len(runs))],
        looks=[look(i) for i in range(len(runs))],
        colors=palette.css(),
        run_colors=palette.RUNS,
        shades=SHADES,
        compared=[comparison(runs, names, numbers, k, scores) for k in range(1, len(runs))],
        heading=shared_tracks(runs),
        tracks=[run.track for run in runs],
        table=table(runs[0].lungs, numbers),
        draws=[panels.draws(score) for score in scores or ()],
        lungs=sections(runs, names, numbers),
        pips=runs[0].pips,
        protocol=protocol,
        scored=[breath + 1 for breath in protocol.SCORED_BREATHS],
        shown_breath=panels.BREATH + 1,
        official=scores is not None,
        provenance=[panels.provenance(score) for score in scores or ()],
        failures=[panels.failures(score) for score in scores or ()],
        version=ventbench.__version__,
    )


def comparison(
    runs: Sequence[Trajectories],
    names: Sequence[str],
    numbers: panels.Scores,
    reference: int,
    scores: Sequence[Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """Where the first run is better than another one, by index, and where worse, cell by cell.

    With score files, in the order of the runs, the difference over their draws is paired.
    """
    difference = numbers.cells[0] - numbers.cells[reference]
    lungs = numbers.lungs[0] - numbers.lungs[reference]
    texts = {}
    for key, value, at in (
        ("best", np.nanmin(difference, initial=0.0), np.nanargmin),
        ("worst", np.nanmax(difference, initial=0.0), np.nanargmax),
    ):
        if value != 0.0:
            i, j = np.unravel_index(at(difference), difference.shape)
            where = f"{runs[0].lungs[i]} at PIP {runs[0].pips[j]:g}"
            texts[key] = f"{number(abs(value))} cmH2O, {where}"
    paired = panels.paired_draws(scores[0], scores[reference]) if scores is not None else None
    mean, low, high = (
        ("", "", "")
        if paired is None
        else (number(x, sign=True) for x in (paired.mean, *paired.ci95))
    )
    return {
        "name": names[reference],
        "lungs": int(np.sum(lungs < 0.0)),
        "cells": int(np.sum(difference < 0.0)),
        "best": texts.get("best", ""),
        "worst": texts.get("worst", ""),
        "draws": f"{mean} [{low}, {high}]" if mean else "",
        "count": 0 if paired is None else paired.count,
        "rows": [
            {
                "name": lung,
                "cells": [{"text": _signed(value), "shade": _shade(value)} for value in row],
                "mean": _signed(mean),
            }
            for lung, row, mean in zip(runs[0].lungs, difference, lungs, strict=True)
        ],
    }


def _shade(difference: float) -> str:
    step = int(np.searchsorted(SHADE_LIMITS, abs(difference)))
    return f"{'b' if difference < 0.0 else 'w'}{step}" if step and np.isfinite(difference) else ""


def table(lungs: Sequence[str], numbers: panels.Scores) -> list[dict[str, Any]]:
    """Rows of the score table: the mean, then each lung; for each run text, difference, best."""
    rows = [("All lungs", numbers.overall), *zip(lungs, numbers.lungs.T, strict=True)]
    return [{"name": name, "cells": _cells(values)} for name, values in rows]


def sections(
    runs: Sequence[Trajectories], names: Sequence[str], numbers: panels.Scores
) -> list[dict[str, Any]]:
    """A lung each: its numbers and its panels."""
    return [
        {
            "id": lung,
            "R": f"{parse_lung(lung).R:g}",
            "C": f"{parse_lung(lung).C:g}",
            "scores": [number(value) for value in numbers.lungs[:, i]],
            "panels": [
                _panel(runs, i, j, names, numbers.cells[:, i, j]) for j in range(len(runs[0].pips))
            ],
        }
        for i, lung in enumerate(runs[0].lungs)
    ]


def look(k: int) -> str:
    """Classes of the lines of a run, by its place."""
    return f"r{palette.run_index(k)}" + " dash" * (k >= len(palette.RUNS))


def _panel(
    runs: Sequence[Trajectories], i: int, j: int, names: Sequence[str], errors: Floats
) -> dict[str, Any]:
    errors_text = "; ".join(
        f"{name} {number(e)}{' cmH2O' if np.isfinite(e) else ''}"
        for name, e in zip(names, errors, strict=True)
    )
    lung, pip = runs[0].lungs[i], f"{runs[0].pips[j]:g}"
    targets = runs[0].target[:, j, panels.WINDOW]
    of_pip = [run.pressure[:, j, panels.WINDOW] for run in runs]
    # The same axis down a column.
    pressure, valve = panels.axes(targets[i], panels.pressure_limits(targets, of_pip))
    inspired = slice(protocol.INSPIRATION_STEPS)
    times = panels.TIMES[inspired]
    pressure.between("r0", times, of_pip[0][i][inspired], targets[i][inspired])
    pressure.line("t", panels.TIMES, targets[i])
    for k, run in reversed([*enumerate(runs)]):
        pressure.line(f"p {look(k)} n{k} after", panels.TIMES, of_pip[k][i])
        pressure.line(f"p {look(k)} n{k}", times, of_pip[k][i][inspired])
        u_in = np.clip(run.u_in[i, j, panels.WINDOW], 0.0, protocol.U_MAX)
        valve.held(f"u {look(k)} n{k}", panels.TIMES, u_in)
    return {
        "pip": pip,
        "alt": f"{lung} at PIP {pip} cmH2O: pressure and u_in over one breath. "
        f"Mean absolute error: {errors_text}.",
        "errors": [number(error) for error in errors],
        "charts": (pressure, valve),
        "above": panels.above(pressure, [of_pip[0][i]]),
    }


def _cells(values: Floats) -> list[dict[str, Any]]:
    """One row of the score table; nothing is best where there is nothing to compare."""
    best = np.nanmin(values) if len(values) > 1 and np.isfinite(values).any() else np.nan
    base = values[1] if len(values) > 1 else np.nan
    return [
        {
            "text": number(value),
            "best": bool(value == best),
            "failed": not np.isfinite(value),
            **_difference(value - base if i != 1 else np.nan),
        }
        for i, value in enumerate(values)
    ]


def _difference(value: float) -> dict[str, str]:
    """Text of a difference and whether that is better; what rounds to 0.00 is neither."""
    if not np.isfinite(value):
        return {"difference": "", "class": ""}
    kind = "same" if round(value, 2) == 0.0 else "better" if value < 0.0 else "worse"
    return {"difference": _signed(value), "class": kind}


def _signed(difference: float) -> str:
    """Text of a difference, of which what rounds to 0.00 has no sign."""
    return "±0.00" if round(difference, 2) == 0.0 else number(difference, sign=True)


#: Values of D that are shown beside the best one, %/cmH2O.
SLICES = (0.0, 0.3, 1.0, 3.0, 10.0)

#: Errors above this multiple of the least one of a row look alike.
SATURATION = 3.0

#: Dots per inch of the chart.
DPI = 110


def gain_map_png(grid: PIDGrid, *, each: bool = True, single: bool = True) -> bytes:
    """Draw the grid of PID gains: error over P and I, one row a lung, one map a value of D.

    ``each`` shows each lung, ``single`` the mean over several lungs.

    Raises:
        InputError: if matplotlib is missing.
    """
    errors.require("matplotlib")
    from matplotlib.figure import Figure

    error = grid.error.mean(axis=-1, dtype=np.float64)
    rows = list(zip(grid.lungs, error, strict=True)) if each else []
    if single and len(grid.lungs) > 1:
        rows.append(("mean of all", error.mean(axis=0)))
    columns = len(SLICES) + 1
    size = 2.5 * columns + 0.8, 2.5 * len(rows) + 0.7
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle("Mean |pressure - target|, cmH2O; cross: the least of the map")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, (name, values) in zip(axes, rows, strict=True):
        _row(figure, line, name, grid.gains, values)
    output = io.BytesIO()
    # Without the version of matplotlib, equal figures give equal bytes.
    figure.savefig(output, format="png", dpi=DPI, metadata={"Software": None})
    return output.getvalue()


def _row(figure: Any, axes: Any, name: str, gains: Floats, error: Floats) -> None:
    best = int(np.argmin(error))
    slices_of_grid = [d for d in SLICES if np.any(gains[:, 2] == d)]
    slices = [("best: ", float(gains[best, 2])), *(("", d) for d in slices_of_grid)]
    low, image = float(error[best]), None
    for axis, (prefix, d) in zip(axes, slices, strict=False):
        image = _map(axis, gains, error, d, (low, SATURATION * low))
        axis.set_title(f"{prefix}D = {d:g}", fontsize=9)
    for axis in axes[len(slices) :]:
        axis.set_axis_off()
    gain = ", ".join(f"{value:g}" for value in gains[best])
    axes[0].set_ylabel(f"{name}\n{gain}: {low:.3f}\nP", fontsize=9)
    figure.colorbar(image, ax=list(axes), shrink=0.9, extend="max")


def _map(axis: Any, gains: Floats, error: Floats, d: float, limits: tuple[float, float]) -> Any:
    """One map; the values are not evenly spaced, so each is one cell wide."""
    import pandas as pd

    table = pd.DataFrame(gains, columns=["P", "I", "D"]).assign(error=error)
    values = table[table["D"] == d].pivot(index="P", columns="I", values="error")
    low, high = limits
    image = axis.imshow(
        values, origin="lower", cmap="viridis_r", vmin=low, vmax=high, aspect="auto"
    )
    y, x = np.unravel_index(int(np.nanargmin(values)), values.shape)
    axis.plot(x, y, marker="x", color="#e2603c", markersize=7, markeredgewidth=2)
    axis.set_xlabel("I", fontsize=8)
    for ticks, mark in ((values.columns, axis.set_xticks), (values.index, axis.set_yticks)):
        at = np.unique(np.linspace(0, ticks.size - 1, 5).round().astype(int))
        mark(at, [f"{ticks[k]:g}" for k in at], fontsize=7)
    return image
