"""Numbers and foreign text as people read them."""

from __future__ import annotations

import math

import pytest

from ventbench.base.text import number, plain


@pytest.mark.parametrize(
    ("value", "sign", "text"),
    [
        (1.234, False, "1.23"),
        (-1.236, True, "−1.24"),
        (0.5, True, "+0.50"),
        (-0.001, False, "0.00"),
        (None, False, "–"),
        (math.nan, False, "failed"),
    ],
)
def test_number(value: float | None, sign: bool, text: str) -> None:
    assert number(value, sign=sign) == text


def test_foreign_text_is_plain() -> None:
    assert plain("a\tb\u202ec\x1b") == "a b\N{REPLACEMENT CHARACTER}c\N{REPLACEMENT CHARACTER}"
    assert plain("0.5 cmH₂O") == "0.5 cmH₂O"
