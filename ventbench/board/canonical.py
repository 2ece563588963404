"""Canonical JSON: one text for a value, so that its SHA-256 names it.

ASCII, keys sorted, no spaces, floats in the shortest form that reads back as the same float (as
Python and JavaScript print them), no NaN, no infinity, one line that ends with a newline. The bytes
of a file are what is hashed, so that ``sha256sum FILE`` gives its name.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from ventbench.errors import InputError


def canonical(value: Any) -> bytes:
    """Return the canonical text of a JSON value.

    Args:
        value: of dicts with text keys, lists or tuples, text, numbers, booleans and None.

    Raises:
        ValueError: if a number is not finite.
        TypeError: if it holds anything else, or a key that is not text.
    """
    _only_text_keys(value)
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.encode("ascii") + b"\n"


def digest(content: bytes) -> str:
    """SHA-256 as hexadecimal text."""
    return hashlib.sha256(content).hexdigest()


def parse(content: bytes, label: str) -> Any:
    """Read a canonical text, and no other one: not even with a space more or a key twice.

    Args:
        content: of the file.
        label: names it in messages.

    Raises:
        InputError: if it is not JSON, or not canonical.
    """
    try:
        value = json.loads(content)
    # ValueError: also not UTF-8, and integers of thousands of digits.
    except (ValueError, RecursionError) as error:
        why = "it is no text" if isinstance(error, UnicodeDecodeError) else error
        raise InputError(f"{label} is not JSON: {why}") from None
    try:
        same = canonical(value) == content
    except (ValueError, TypeError, RecursionError):
        same = False
    if not same:
        raise InputError(
            f"{label} is not in canonical form (keys sorted and once, no spaces, shortest floats, "
            "a newline at the end); records are written by ventbench and never edited"
        )
    return value


def through_json(value: Any) -> Any:
    """The value as a reader of its JSON gets it: tuples become lists."""
    return json.loads(canonical(value))


def _only_text_keys(value: Any) -> None:
    """Refuse keys like 1: json.dumps would turn it into "1", and so two keys into one."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            if not isinstance(key, str):
                raise TypeError(f"key {key!r} is not text")
            _only_text_keys(part)
    elif isinstance(value, list | tuple):
        for part in value:
            _only_text_keys(part)
