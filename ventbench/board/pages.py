"""What all pages share: template environment, policy, addresses, and numbers and text as shown.

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

from ventbench import palette, protocol
from ventbench.board.ranking import Interval
from ventbench.text import number, page_templates, plain

if TYPE_CHECKING:
    import jinja2

#: Version that this ventbench scores.
CURRENT = protocol.VERSION

#: Shown where there is nothing to show.
NONE = "–"

#: Longest text and most rows of what a record says about itself, on a page.
MAX_CHARACTERS, MAX_ROWS = 300, 100

TITLES = {"performance": "Performance", "robustness": "Robustness"}


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


def version_path(version: int, versions: Sequence[int]) -> str:
    """Address of a version's board; the newest one is the front page.

    Args:
        version: of the protocol.
        versions: all of them, newest first.
    """
    return "index.html" if version == versions[0] else f"version-{version}.html"


def entry_path(version: int, track: str, name: str) -> str:
    """Address of an entry; names are checked when records are read."""
    return f"entries/v{version}/{track}/{name}.html"


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


def interval(estimate: Interval | None, digits: int = 3) -> dict[str, Any] | None:
    """A score for a template: text, limits, value to sort by."""
    if estimate is None:
        return None
    limits = f"{number(estimate.low, digits)} to {number(estimate.high, digits)}"
    text = number(estimate.value, digits)
    return {"text": text, "limits": limits, "value": f"{estimate.value:.9f}"}


def difference(estimate: Interval | None, digits: int = 3) -> dict[str, Any] | None:
    """A difference for a template, and whether it is clear: below zero is better."""
    if estimate is None:
        return None
    low, high = (number(x, digits, sign=True) for x in (estimate.low, estimate.high))
    limits = f"{low} to {high}"
    kind = "same" if not estimate.clear else "better" if estimate.value < 0 else "worse"
    text = number(estimate.value, digits, sign=True)
    return {"text": text, "limits": limits, "value": f"{estimate.value:.9f}", "kind": kind}


def step_time(timing: Mapping[str, Any]) -> float:
    """Median time of one ``act``, µs; NaN where the record does not say."""
    value = timing.get("act_median_us")
    good = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if good else math.nan  # type: ignore[arg-type]


def flatten(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """What a record says about itself, as pairs of text; not escaped."""
    rows: list[tuple[str, str]] = []
    _flatten(value, prefix, rows)
    return rows[:MAX_ROWS]


def _flatten(value: Any, prefix: str, rows: list[tuple[str, str]]) -> None:
    if isinstance(value, Mapping):
        for key, part in value.items():
            _flatten(part, f"{prefix} {key}".strip(), rows)
        return
    parts = value if isinstance(value, list | tuple) else [value]
    if any(isinstance(part, Mapping | list | tuple) for part in parts):
        for index, part in enumerate(parts):
            _flatten(part, f"{prefix} {index + 1}".strip(), rows)
        return
    text = ", ".join(_short(part) for part in parts if part is not None)
    if text:
        cut = text if len(text) <= MAX_CHARACTERS else text[: MAX_CHARACTERS - 1] + "…"
        rows.append((prefix, cut))


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
