"""The limits of the house are those of a checkout, and a thing beyond one is named."""

from __future__ import annotations

from pathlib import Path

from ci import house


def test_this_checkout_is_within_its_limits() -> None:
    table, wrong = house.problems(house.ROOT)
    assert wrong == []
    assert any(line.startswith("ventbench/plants/") for line in table)


def test_packing_and_layout_change_no_count() -> None:
    plain = "def f(\n    a,\n    b,\n):\n    # why\n    return a + b * 2\n"
    packed = "def f(a, b,): return a + b * 2\n"
    assert house.tokens_of(plain) == house.tokens_of(packed) == 15


def test_what_is_beyond_a_limit_is_named(tmp_path: Path) -> None:
    for package in ("ventbench", "hardware_eval"):
        (tmp_path / package).mkdir()
    (tmp_path / "ventbench" / "long.py").write_text("x\n" * (house.LIMITS["ventbench"] + 1))
    (tmp_path / "ventbench" / "packed.py").write_text("x = [1,\n 2]  # fmt: " + "skip\n")
    (tmp_path / "hardware_eval" / "old.py").write_text("if protocol == 1:\n    pass\n")
    _, wrong = house.problems(tmp_path)
    for words in ("old.py branches on", "packed.py is formatted by hand", "ventbench: "):
        assert any(words in line for line in wrong), words
    assert len(wrong) == 3
