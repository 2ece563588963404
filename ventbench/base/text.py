"""Numbers and foreign text as reports, pages and messages show them; templates of pages."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from ventbench.base.errors import require

if TYPE_CHECKING:
    import jinja2

#: Longest text and most rows of what a file says about itself, on a page.
MAX_CHARACTERS, MAX_ROWS = 300, 100


def number(value: float | None, digits: int = 2, sign: bool = False) -> str:
    """Text of a figure; a dash for none, "failed" for NaN; a true minus sign."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return "failed"
    # + 0.0 turns -0.0, which rounding may leave, into 0.0.
    return f"{round(value, digits) + 0.0:{'+' if sign else ''}.{digits}f}".replace("-", "−")


def few(items: Sequence[str], most: int = 3) -> str:
    """The first of several items, and how many more there are."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return ", ".join(items[:most]) + more


def suggestion(word: str, choices: Iterable[str], cutoff: float = 0.6) -> str:
    """The nearest of some choices as the end of a message; empty if none is near."""
    close = get_close_matches(word, list(choices), 1, cutoff)
    return f"; did you mean {close[0]}?" if close else ""


def plain(text: str) -> str:
    """Text in which nothing is invisible or turns the reading direction; not escaped."""
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() else " " if c in "\n\t" else "\N{REPLACEMENT CHARACTER}" for c in text
    )


# Characters that are printable by their category and yet show nothing (default-ignorable).
_IGNORABLE = re.compile(
    "[\u00ad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f\u202a-\u202e\u2060-\u206f"
    "\u3164\ufe00-\ufe0f\ufeff\uffa0\ufff0-\ufff8\U0001bca0-\U0001bca3\U0001d173-\U0001d17a"
    "\U000e0000-\U000e0fff]"
)


def deceptive(text: str) -> str:
    """Say why a name may look like another one; empty if it cannot.

    Characters that show nothing, and words whose letters come from several scripts.
    """
    if not text.isprintable() or _IGNORABLE.search(text) or not text.strip():
        return f"{plain(text)!r} holds a character that cannot be seen"
    for word in re.findall(r"[^\W\d_]+", text):
        scripts = {
            unicodedata.name(c, "?").split()[0] for c in word if unicodedata.category(c) != "Lm"
        }
        # Those of Asia are written together.
        if len(scripts - {"CJK", "HIRAGANA", "KATAKANA", "FULLWIDTH", "HALFWIDTH"}) > 1:
            return f"{word!r} mixes the letters of {' and '.join(sorted(scripts)).lower()}"
    return ""


def escape_markdown(text: str) -> str:
    """Make text plain in Markdown: no link, image, table or heading can come from it."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(text.split()))


def flatten(value: Any) -> list[tuple[str, str]]:
    """JSON values as pairs of name and text for a table, cut and not escaped."""
    return list(_pairs(value, ""))[:MAX_ROWS]


def _pairs(value: Any, prefix: str) -> Iterator[tuple[str, str]]:
    parts = value if isinstance(value, list | tuple) else [value]
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _pairs(part, f"{prefix} {key}".strip())
    elif any(isinstance(part, Mapping | list | tuple) for part in parts):
        for index, part in enumerate(parts):
            yield from _pairs(part, f"{prefix} {index + 1}".strip())
    elif text := ", ".join(_short(part) for part in parts if part is not None):
        cut = text if len(text) <= MAX_CHARACTERS else text[: MAX_CHARACTERS - 1] + "…"
        yield prefix, cut


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def page_templates(
    package: str, *, shown: Callable[[Any], Any] | None = None
) -> jinja2.Environment:
    """Environment of the templates in ``templates/`` of a package, with one set of rules.

    Text is passed through ``shown`` and escaped, and a missing value is an error.

    Raises:
        InputError: if jinja2 is not installed.
    """
    require("jinja2")
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader(package),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=shown,
    )
