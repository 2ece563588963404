"""Forms of JSON values: small checks, put together by :mod:`ventbench.board.schema`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

#: Longest text anywhere in a record, characters.
MOST_TEXT = 4000

SHA256 = re.compile(r"[0-9a-f]{64}")
LUNG = re.compile(r"R\d{1,4}(\.\d{1,3})?C\d{1,4}(\.\d{1,3})?")
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")

Check = Callable[[Any], bool]


def text(value: Any) -> bool:
    """Text of bearable length."""
    return isinstance(value, str) and len(value) <= MOST_TEXT


def pattern(wanted: re.Pattern[str]) -> Check:
    """Text that matches as a whole."""
    return lambda value: isinstance(value, str) and wanted.fullmatch(value) is not None


def number(value: Any) -> bool:
    """A finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def count(value: Any) -> bool:
    """A whole number that is not negative."""
    return type(value) is int and 0 <= value < 2**53


def flag(value: Any) -> bool:
    """True or false."""
    return isinstance(value, bool)


def or_none(check: Check) -> Check:
    """Null, or of a form."""
    return lambda value: value is None or check(value)


def one_of(*choices: Any) -> Check:
    """One of some values, also by type."""
    return lambda value: any(type(value) is type(choice) and value == choice for choice in choices)


def listed(check: Check, *shape: int | None) -> Check:
    """Check nested lists of a shape (None: any length)."""
    if not shape:
        return check
    inner = listed(check, *shape[1:])

    def checked(value: Any) -> bool:
        right = isinstance(value, list) and (shape[0] is None or len(value) == shape[0])
        return right and all(map(inner, value))

    return checked


def grid(row: Check, *shape: int) -> Check:
    """Check nested lists of a shape whose rows are checked whole: quick for many numbers."""
    rows = listed(row, *shape[:-1])
    return lambda value: rows(value) and _length(value, shape)


def _length(value: list[Any], shape: tuple[int, ...]) -> bool:
    if len(shape) == 1:
        return len(value) == shape[0]
    return all(_length(part, shape[1:]) for part in value)


def whole_row(value: Any, low: int = -(2**31), high: int = 2**31) -> bool:
    """A list of whole numbers within limits."""
    # By type: True is an instance of int.
    good = isinstance(value, list) and set(map(type, value)) <= {int}
    return good and (not value or (low <= min(value) and max(value) <= high))


def count_row(value: Any) -> bool:
    """A list of whole numbers that are not negative."""
    return whole_row(value, low=0)


def number_row(value: Any) -> bool:
    """A list of finite numbers and nulls."""
    if not isinstance(value, list) or not set(map(type, value)) <= {int, float, type(None)}:
        return False
    return all(map(math.isfinite, [x for x in value if x is not None]))


def table(**checks: Check) -> Check:
    """Check an object with exactly these keys."""
    return lambda value: (
        isinstance(value, dict)
        and value.keys() == checks.keys()
        and all(check(value[key]) for key, check in checks.items())
    )


def free(value: Any, depth: int = 6) -> bool:
    """JSON of any form, of bounded depth: what a record says about its machine and the like."""
    if isinstance(value, dict):
        return depth > 0 and all(text(k) and free(v, depth - 1) for k, v in value.items())
    if isinstance(value, list):
        return depth > 0 and all(free(v, depth - 1) for v in value)
    return value is None or flag(value) or number(value) or text(value)


def object_(value: Any) -> bool:
    """An object of any form."""
    return isinstance(value, dict) and free(value)
