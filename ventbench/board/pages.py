"""What pages share and draw: policy, numbers as shown, tables, and SVG of numbers only.

Pages stand alone: no network, no cookie, no address outside the leaderboard. The policy in their
head allows the one style and the one script that are in them, by hash; all text of records is
escaped by the templates and printable.

Traces are 6 x 6 small multiples in whole numbers and short paths, since there are many. A panel is
the nominal inspiration of the last scored breath on one lung at one PIP: pressure above, u_in
below. Axes depend on the PIP alone, so that panels of all entries can be laid side by side. Lengths
are in units of the panel, y downwards.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from ventbench import palette
from ventbench.base.arrays import Floats
from ventbench.base.interval import Interval
from ventbench.base.text import number, page_templates, plain
from ventbench.board.ranking import HardwareRow, Row, stressed_runs
from ventbench.entries.runs import order
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.stressors import CATEGORIES, SEVERITIES, Condition, conditions, stressor

if TYPE_CHECKING:
    import jinja2

    from ventbench.board.record import Record

#: Shown where there is nothing to show.
NONE = "–"

#: Most conditions that are listed by what they add to the error of an entry.
WORST = 12

#: Shares of survived runs below which a field of the stress chart gets the next darker shade.
SHARES = (1.0, 0.95, 0.85, 0.7, 0.5, 0.3)


def environment() -> jinja2.Environment:
    """Make the template environment; every value is escaped.

    Raises:
        InputError: if jinja2 is not installed.
    """
    templates = page_templates("ventbench.board", shown=_printable)
    style, script = palette.css() + _asset("board.css"), _asset("board.js")
    templates.globals.update(
        address=address,
        figure=figure,
        style=trusted(style),
        script=trusted(script),
        policy=(
            f"default-src 'none'; style-src 'sha256-{_hash(style)}'; "
            f"script-src 'sha256-{_hash(script)}'; base-uri 'none'; form-action 'none'"
        ),
    )
    return templates


def address(record: Record) -> str:
    """Address of the entry of a record; names are checked when records are read."""
    return f"entries/{record.draws}/{record.track}/{record.name}.html"


@functools.cache
def _asset(name: str) -> str:
    return resources.files("ventbench.board").joinpath("templates", name).read_text("utf-8")


def _hash(content: str) -> str:
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()


def trusted(content: str) -> Any:
    """Mark text of our own making, in which nothing comes from a record, as not to be escaped."""
    from markupsafe import Markup

    return Markup(content)


def _printable(value: Any) -> Any:
    """A template's value in which nothing is invisible; escaping is the template's."""
    return plain(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def figure(value: float, digits: int = 3, *, sign: bool = False) -> str:
    """A number; a dash if it does not exist."""
    return number(value, digits, sign=sign) if math.isfinite(value) else NONE


def interval(estimate: Interval | None, digits: int, *, sign: bool = False) -> dict[str, Any]:
    """A figure with its limits for a template: texts, value to sort by, and its kind.

    ``sign`` tells a difference, of which less than zero is better; None does not exist.
    """
    if estimate is None:
        return {"text": NONE, "small": "", "value": "", "kind": "none"}
    text, low, high = (
        number(x, digits, sign=sign) for x in (estimate.value, estimate.low, estimate.high)
    )
    kind = "" if not sign else "same" if not estimate.clear else "worse"
    kind = "better" if kind == "worse" and estimate.value < 0 else kind
    return {
        "text": text,
        "small": f"{low} to {high}",
        "value": f"{estimate.value:.9f}",
        "kind": kind,
    }


def step_time(timing: Mapping[str, Any]) -> float:
    """Median time of one ``act``, µs; NaN where the record does not say."""
    value = timing.get("act_median_us")
    good = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if good else math.nan  # type: ignore[arg-type]


def hardware_of(rows: Sequence[HardwareRow], name: str) -> HardwareRow | None:
    """The row that stands for an entry: attested ones first, a physical lung before an emulator."""
    counting = [row for row in rows if row.newest and row.record.name == name]
    return min(counting, key=lambda row: (bool(row.reasons), row.record.emulated), default=None)


def stress_context(row: Row) -> dict[str, Any]:
    """A row of the stress track for the templates."""
    runs = stressed_runs(row)
    figures = runs.headline()
    return {
        "row": row,
        "score": None if row.stress is None else interval(row.stress, 2),
        "unstressed": number(figures["unstressed"], 2),
        "unstressed_survived": f"{100 * figures['survived_unstressed']:.0f}",
        "rise": number(figures["rise"], 2, sign=True),
        "rise_value": "" if figures["rise"] is None else f"{figures['rise']:.6f}",
        "survived": f"{100 * figures['survived']:.1f}",
        "unsafe": figures["unsafe_runs"],
        "runs": figures["stressed_runs"],
        "alarm": number(figures["above_alarm_s"], 2),
        "worst": number(figures["worst_error"], 1),
        "worst_where": title_of(figures["worst_condition"]),
    }


def stress_order(row: Row) -> list[dict[str, str]]:
    """Conditions by what they add to the error of the same cells without a stressor, most first.

    Each has a ``title``, the ``rise`` with its 95 % interval ``small``, cmH2O, and the share of the
    runs that it leaves, ``survived``, %. A condition in which a run failed comes first.
    """
    by_condition = stressed_runs(row).by_condition[1:]
    most_first = sorted(by_condition, key=lambda row: order(row["rise_cmH2O"]), reverse=True)
    lines = []
    for figures in most_first[:WORST]:
        low, high = figures["rise_ci95"]
        lines.append(
            {
                "title": title_of(figures["condition"]),
                "rise": number(figures["rise_cmH2O"], 2, sign=True),
                "small": (
                    f"{number(low, 2, sign=True)} to {number(high, 2, sign=True)}"
                    if low is not None
                    else ""
                ),
                "survived": f"{100 * figures['survived']:.0f}",
            }
        )
    return lines


def stress_chart(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Stressor by severity: groups of rows, with fields of entries under the same conditions.

    A group a category with ``title`` and ``rows``; a row has a ``title`` and ``fields``, for each
    entry one of each severity.
    """
    if not rows:
        return []
    index = {condition: k for k, condition in enumerate(stressed_runs(rows[0]).conditions)}
    groups: dict[str, list[dict[str, Any]]] = {
        title.capitalize(): [] for title in (*CATEGORIES.values(), _PAIRS)
    }
    for names in dict.fromkeys(c.stressors for c in index if c.stressors):
        title = " + ".join(stressor(name).title for name in names)
        group = CATEGORIES[stressor(names[0]).category] if len(names) == 1 else _PAIRS
        columns = [(Condition(names, severity), f"{title}, {severity}") for severity in SEVERITIES]
        fields = [
            _field(entry, index[condition], said) if condition in index else None
            for entry in rows
            for condition, said in columns
        ]
        groups[group.capitalize()].append({"title": title, "fields": fields})
    return [{"title": title, "rows": lines} for title, lines in groups.items() if lines]


#: Title of the conditions of two stressors.
_PAIRS = "two at once, both mild"


def title_of(condition: str) -> str:
    """A condition's id in words."""
    for candidate in conditions():
        if candidate.id == condition:
            titles = " + ".join(stressor(name).title for name in candidate.stressors)
            return f"{titles}, {candidate.severity}" if titles else "without stressor"
    return condition


def _field(entry: Row, at: int, title: str) -> dict[str, Any]:
    figures = stressed_runs(entry).by_condition[at]
    share, unsafe = figures["survived"], figures["unsafe_runs"]
    return {
        "share": f"{100 * share:.0f}",
        "rise": number(figures["rise_cmH2O"], 1, sign=True),
        "unsafe": unsafe,
        "shade": f"s{sum(share < limit for limit in SHARES)}",
        "said": f"{entry.record.name}, {title}: {100 * share:.0f} % survived, {unsafe} unsafe",
    }


#: Limits between the shades of maps, cmH2O and points of the normalised score: the same for all
#: entries, so that maps can be compared.
ERROR_LIMITS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 7.0, 10.0)
NORMALISED_LIMITS = (5.0, 15.0, 30.0, 50.0, 75.0, 100.0, 150.0, 250.0)

#: Size of a panel, left of its plots, units from one step to the next.
WIDTH, HEIGHT = 690, 600
LEFT, STEP = 70, 18

#: Top and height of the two plots.
TOP, PRESSURE_HEIGHT = 14, 350
VALVE_TOP, VALVE_HEIGHT = 400, 140

RIGHT = LEFT + STEP * protocol.INSPIRATION_STEPS
VALVE_BOTTOM = VALVE_TOP + VALVE_HEIGHT


def heat_map(values: Floats, limits: tuple[float, ...], digits: int = 2) -> list[dict[str, Any]]:
    """Rows of a map of means over draws of values ``(1 + K, L, P)``; the first ones stand beside.

    Shades change at the limits.
    """
    means = values[1:].mean(axis=0)
    return [
        {
            "name": lung,
            "cells": [
                {
                    "text": number(value, digits),
                    "small": number(nominal, digits),
                    "shade": f"h{np.searchsorted(limits, value)}" if np.isfinite(value) else "hx",
                }
                for value, nominal in zip(means[i], values[0, i], strict=True)
            ],
            "mean": number(float(means[i].mean()), digits),
        }
        for i, lung in enumerate(LUNG_IDS)
    ]


def _y(pressure: Floats | float, pip: float) -> Floats:
    height = pip - protocol.PEEP  # the axis: a little below PEEP, and room for an overshoot of 60 %
    low, high = protocol.PEEP - 0.12 * height, pip + 0.6 * height
    share = (high - np.asarray(pressure)) / (high - low)
    return TOP + PRESSURE_HEIGHT * np.clip(share, 0.0, 1.0)


@functools.cache
def frame(pip: float) -> str:
    """What all panels of a PIP share, as SVG: target, ticks, time axis."""
    end = LEFT + round(1.0 / protocol.DT * STEP)
    ticks = [(value, round(float(_y(value, pip)))) for value in (protocol.PEEP, pip)]
    rules = [VALVE_TOP, VALVE_BOTTOM, *(y for _, y in ticks)]
    lines = "".join(f"M{LEFT} {y}H{RIGHT}" for y in rules)
    times = (("0", LEFT), ("0.5", (LEFT + end) // 2), ("1 s", end))
    return "".join(
        [
            f'<path class="t" d="M{LEFT} {round(float(_y(pip, pip)))}H{RIGHT - STEP}"/>',
            f'<path class="rule" d="{lines}"/>',
            *(f'<text class="y" x="{LEFT - 10}" y="{y + 9}">{v:g}</text>' for v, y in ticks),
            *(f'<text class="x" x="{x}" y="{HEIGHT - 18}">{text}</text>' for text, x in times),
        ]
    )


def panels(
    traces: list[list[tuple[str, str]]], pid: list[list[tuple[str, str]]] | None
) -> list[list[str]]:
    """What is drawn in each panel, as SVG of numbers only; a template would take ten times as long.

    Takes paths of the entry and of the PID, if that is drawn, from :func:`paths`.
    """
    return [
        [
            (
                f'<path class="p pid" d="{pid[i][j][0]}"/><path class="u pid" d="{pid[i][j][1]}"/>'
                if pid
                else ""
            )
            + f'<path class="p own" d="{pressure}"/><path class="u own" d="{valve}"/>'
            for j, (pressure, valve) in enumerate(row)
        ]
        for i, row in enumerate(traces)
    ]


def paths(record: Record) -> list[list[tuple[str, str]]]:
    """Paths of pressure and command of each lung and PIP."""
    valves = np.rint(VALVE_BOTTOM - VALVE_HEIGHT * record.figures.u_in / protocol.U_MAX).astype(int)
    columns = []
    for j, pip in enumerate(protocol.PIPS):
        heights = np.rint(_y(record.figures.pressure[:, j], pip)).astype(int)
        moves = np.diff(heights, axis=-1)
        rows = zip(heights[:, 0].tolist(), moves.tolist(), valves[:, j].tolist(), strict=True)
        columns.append(
            [  # a path through points one step apart, relative to each other
                (f"m{LEFT} {first}" + "".join([f" {STEP} {move}" for move in rest]), _stairs(valve))
                for first, rest, valve in rows
            ]
        )
    return [list(row) for row in zip(*columns, strict=True)]


def _stairs(heights: list[int]) -> str:
    """A command holds until the next step; equal ones are joined."""
    parts, before, run = [f"M{LEFT} {heights[0]}"], heights[0], 0
    for height in heights:
        if height != before:
            parts.append(f"h{run}V{height}")
            before, run = height, 0
        run += STEP
    return "".join([*parts, f"h{run}"])
