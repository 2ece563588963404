"""What pages share: environment, policy, addresses, numbers as shown, stress and hardware tables.

Pages stand alone: no network, no cookie, no address outside the leaderboard. The policy in their
head allows the one style and the one script that are in them, by hash; all text of records is
escaped by the templates and printable.
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
from ventbench.base.text import number, page_templates, plain
from ventbench.board.ranking import HardwareRow, Interval, StressRow
from ventbench.task.stressors import CATEGORIES, SEVERITIES, Condition, conditions, stressor

if TYPE_CHECKING:
    import jinja2

    from ventbench.board.record import Record

#: Shown where there is nothing to show.
NONE = "–"

#: Shares of survived runs below which a field of the stress chart gets the next darker shade.
SHARES = (1.0, 0.95, 0.85, 0.7, 0.5, 0.3)


def environment() -> jinja2.Environment:
    """Make the template environment; every value is escaped.

    Raises:
        InputError: if jinja2 is not installed.
    """
    made = page_templates("ventbench.board", shown=_shown)
    style, script = palette.css() + _asset("board.css"), _asset("board.js")
    made.globals.update(
        style=trusted(style),
        script=trusted(script),
        policy=(
            f"default-src 'none'; style-src 'sha256-{_hash(style)}'; "
            f"script-src 'sha256-{_hash(script)}'; base-uri 'none'; form-action 'none'"
        ),
    )
    return made


def entry_path(draws: str, track: str, name: str) -> str:
    """Address of an entry; names are checked when records are read."""
    return f"entries/{draws}/{track}/{name}.html"


def address(record: Record) -> str:
    """Address of the entry of a record."""
    return entry_path(record.header.draws.season, record.track, record.name)


@functools.cache
def _asset(name: str) -> str:
    return resources.files("ventbench.board").joinpath("templates", name).read_text("utf-8")


def _hash(content: str) -> str:
    return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()


def trusted(content: str) -> Any:
    """Mark text of our own making, in which nothing comes from a record, as not to be escaped."""
    from markupsafe import Markup

    return Markup(content)


def _shown(value: Any) -> Any:
    """A template's value in which nothing is invisible; escaping is the template's."""
    return plain(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def figure(value: float, digits: int = 3) -> str:
    """A number; a dash if it does not exist."""
    return number(value, digits) if math.isfinite(value) else NONE


def signed(value: float, digits: int = 3) -> str:
    """A number with its sign; a dash if it does not exist."""
    return number(value, digits, sign=True) if math.isfinite(value) else NONE


def interval(estimate: Interval | None, digits: int, *, sign: bool = False) -> dict[str, Any]:
    """A figure with its limits for a template: texts, value to sort by, and its kind.

    Args:
        estimate: the figure; None if it does not exist.
        digits: that are shown.
        sign: whether it is a difference, of which less than zero is better.
    """
    if estimate is None:
        return {"text": NONE, "small": "", "value": "", "kind": "none"}
    text, low, high = (
        number(x, digits, sign=sign) for x in (estimate.value, estimate.low, estimate.high)
    )
    kind = "" if not sign else "same" if not estimate.clear else "worse"
    kind = "better" if kind == "worse" and estimate.value < 0 else kind
    return {
        "text": text, "small": f"{low} to {high}", "value": f"{estimate.value:.9f}", "kind": kind,
    }  # fmt: skip


def step_time(timing: Mapping[str, Any]) -> float:
    """Median time of one ``act``, µs; NaN where the record does not say."""
    value = timing.get("act_median_us")
    good = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if good else math.nan  # type: ignore[arg-type]


def hardware_of(made: Sequence[HardwareRow], name: str) -> HardwareRow | None:
    """The row that stands for an entry: attested ones first, a physical lung before an emulator."""
    counting = [row for row in made if row.newest and row.record.name == name]
    return min(counting, key=lambda row: (bool(row.reasons), row.record.emulated), default=None)


def hardware_shown(row: HardwareRow) -> dict[str, Any]:
    """A hardware record for the templates."""
    record, header = row.record, row.record.header
    kind = "emulator" if record.emulated else header.device.name
    spread = "" if math.isnan(record.spread) else f" (SD {figure(record.spread)})"
    return {
        "name": record.name,
        "sha256": record.sha256,
        "path": row.simulated and address(row.simulated.record),
        "listed": row.simulated is not None,
        "value": f"{record.score:.9f}" if math.isfinite(record.score) else "",
        "score": figure(record.score) if math.isfinite(record.score) else "stopped",
        "spread": spread,
        "rank": row.rank,
        "count": row.count,
        "simulated_rank": row.simulated.rank if row.simulated else None,
        "nominal": figure(row.nominal),
        "gap": signed(row.gap),
        "same_code": row.same_code,
        "device": kind,
        "firmware": header.device.firmware,
        "calibration": header.device.calibration[:12],
        "emulated": record.emulated,
        "operator": header.operator,
        "notes": header.notes,
        "created": header.created,
        "lungs": [
            {
                "name": lung,
                "score": figure(float(record.by_lung[i])),
                "peak": figure(header.peak_pressure_cmH2O[i], 1),
                "safe": header.safe[i],
            }
            for i, lung in enumerate(header.lungs)
        ],
        "pips": ", ".join(f"{pip:g}" for pip in header.pips),
        "repeats": header.repeats,
        "stops": [
            f"{stop.lung}, PIP {stop.pip:g}, repetition {stop.repeat}: {stop.reason}"
            for stop in header.stops
        ],
        "newest": row.newest,
        "reasons": list(row.reasons),
        "recording": header.recording.sha256,
    }


def stress_shown(row: StressRow) -> dict[str, Any]:
    """A row of the stress track for the templates."""
    figures = row.tables.headline()
    return {
        "name": row.name,
        "rank": row.rank,
        "ranks": row.ranks,
        "path": address(row.row.record),
        "family": row.row.record.manifest.family,
        "score": None if row.score is None else interval(row.score, 2),
        "unstressed": figure(row.tables.unstressed, 2),
        "rise": signed(_float(figures["rise"]), 2),
        "rise_value": "" if figures["rise"] is None else f"{figures['rise']:.6f}",
        "survived": f"{100 * figures['survived']:.1f}",
        "unsafe": figures["unsafe_runs"],
        "runs": figures["stressed_runs"],
        "alarm": figure(float(np.mean(row.tables.alarm_s[1:])), 2),
        "worst": figure(_float(figures["worst_error"]), 1),
        "worst_where": title_of(figures["worst_condition"]),
    }


def stress_chart(made: Sequence[StressRow]) -> list[dict[str, Any]]:
    """Stressor by severity: groups of rows, each with the fields of every entry.

    Args:
        made: entries under the same conditions; one or several.

    Returns:
        A group a category with ``title`` and ``rows``; a row has a ``title`` and ``fields``, for
        each entry one of each severity.
    """
    if not made:
        return []
    index = {condition: k for k, condition in enumerate(made[0].tables.conditions)}
    groups = []
    for category in CATEGORIES:
        names = dict.fromkeys(
            c.stressors[0]
            for c in index
            if len(c.stressors) == 1 and stressor(c.stressors[0]).category == category
        )
        lines = [
            _line(
                stressor(name).title, [(Condition((name,), s), s) for s in SEVERITIES], made, index
            )
            for name in names
        ]
        groups.append({"title": CATEGORIES[category].capitalize(), "rows": lines})
    pairs = [c for c in index if len(c.stressors) > 1]
    lines = [_line(_pair(c), [(c, "mild"), (None, "")], made, index) for c in pairs]
    groups.append({"title": "Two at once, both mild", "rows": lines})
    return [group for group in groups if group["rows"]]


def title_of(condition: str) -> str:
    """A condition's id in words."""
    for known in conditions():
        if known.id == condition:
            titles = " + ".join(stressor(name).title for name in known.stressors)
            return f"{titles}, {known.severity}" if titles else "without stressor"
    return condition


def _pair(condition: Condition) -> str:
    return " + ".join(stressor(name).title for name in condition.stressors)


def _line(
    title: str,
    columns: Sequence[tuple[Condition | None, str]],
    made: Sequence[StressRow],
    index: dict[Condition, int],
) -> dict[str, Any]:
    fields = []
    for entry in made:
        for condition, severity in columns:
            at = None if condition is None else index.get(condition)
            fields.append(None if at is None else _field(entry, at, f"{title}, {severity}"))
    return {"title": title, "fields": fields}


def _field(entry: StressRow, at: int, title: str) -> dict[str, Any]:
    own = entry.tables.by_condition[at]
    share, rise = own["survived"], _float(own["rise_cmH2O"])
    unsafe = own["unsafe_runs"]
    return {
        "share": f"{100 * share:.0f}",
        "rise": number(rise, 1, sign=True) if math.isfinite(rise) else NONE,
        "unsafe": unsafe,
        "shade": f"s{sum(share < limit for limit in SHARES)}",
        "said": f"{entry.name}, {title}: {100 * share:.0f} % survived, {unsafe} unsafe",
    }


def _float(value: float | None) -> float:
    return math.nan if value is None else value
