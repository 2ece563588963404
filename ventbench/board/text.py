"""Numbers and foreign text as the pages show them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from ventbench.board.ranking import Interval
from ventbench.text import number

#: Shown where there is nothing to show.
NONE = "–"

#: Longest text and most rows of what a record says about itself, on a page.
MOST_CHARACTERS, MOST_ROWS = 300, 100


def plain(value: Any) -> Any:
    """Text in which nothing is invisible or turns the reading direction; other values as they are.

    Escaping is the template's.
    """
    if isinstance(value, str) and not isinstance(value, Markup) and not value.isprintable():
        return "".join(
            c if c.isprintable() else " " if c in "\n\t" else "\N{REPLACEMENT CHARACTER}"
            for c in value
        )
    return value


def figure(value: float, digits: int = 3) -> str:
    """A number; a dash if it does not exist."""
    return number(value, digits) if math.isfinite(value) else NONE


def signed(value: float, digits: int = 3) -> str:
    """A number with its sign; a dash if it does not exist."""
    return number(value, digits, sign=True) if math.isfinite(value) else NONE


def interval(found: Interval | None) -> dict[str, Any] | None:
    """A score for a template: text, limits, value to sort by."""
    if found is None:
        return None
    limits = f"{number(found.low, 3)} to {number(found.high, 3)}"
    return {"text": number(found.value, 3), "limits": limits, "value": f"{found.value:.9f}"}


def difference(found: Interval | None) -> dict[str, Any] | None:
    """A difference likewise, and whether it is clear: below zero is better."""
    if found is None:
        return None
    limits = f"{number(found.low, 3, sign=True)} to {number(found.high, 3, sign=True)}"
    kind = "same" if not found.clear else "better" if found.value < 0 else "worse"
    text = number(found.value, 3, sign=True)
    return {"text": text, "limits": limits, "value": f"{found.value:.9f}", "kind": kind}


def step_time(timing: Mapping[str, Any]) -> float:
    """Median time of one ``act``, µs; NaN where the record does not say."""
    value = timing.get("act_median_us")
    good = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if good else math.nan  # type: ignore[arg-type]


def flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """What a record says about itself, as pairs of text; not escaped."""
    rows: list[tuple[str, str]] = []
    _flatten(value, prefix, rows)
    return rows[:MOST_ROWS]


def _flatten(value: Any, prefix: str, rows: list[tuple[str, str]]) -> None:
    if isinstance(value, Mapping):
        for key, item in value.items():
            _flatten(item, f"{prefix} {key}".strip(), rows)
        return
    items = value if isinstance(value, list | tuple) else [value]
    if any(isinstance(item, Mapping | list | tuple) for item in items):
        for index, item in enumerate(items):
            _flatten(item, f"{prefix} {index + 1}".strip(), rows)
        return
    text = ", ".join(_short(item) for item in items if item is not None)
    if text:
        cut = text if len(text) <= MOST_CHARACTERS else text[: MOST_CHARACTERS - 1] + "…"
        rows.append((prefix, cut))


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
