"""The limits of the house are those of a checkout, and a thing beyond one is named."""

from __future__ import annotations

from pathlib import Path

from ci import house


def test_this_checkout_is_within_its_limits() -> None:
    table, wrong = house.problems(house.ROOT)
    assert wrong == []
    assert any(line.startswith("ventbench/plants/") for line in table)


def test_what_is_beyond_a_limit_is_named(tmp_path: Path) -> None:
    for package in ("ventbench", "hardware_eval", "proofs"):
        (tmp_path / package).mkdir()
    (tmp_path / "ventbench" / "long.py").write_text("x = 1\n" * (house.LONGEST + 1))
    (tmp_path / "hardware_eval" / "old.py").write_text("if protocol == 1:\n    pass\n")
    for k in range(house.LOOSE):
        (tmp_path / "ventbench" / f"m{k}.py").touch()
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "page.md").write_text("word " * house.WORDS)
    (tmp_path / "README.md").write_text("one more")
    (tmp_path / "proofs" / "big.py").write_text("x = 1\n" * (house.LINES["proofs"] + 1))
    _, wrong = house.problems(tmp_path)
    expected = [
        f"ventbench/long.py has {house.LONGEST + 1}",
        "old.py branches on",
        "proofs has",
        f"the docs have {house.WORDS + 2} words",
    ]
    for words in (*expected, f"{house.LOOSE + 1} modules"):
        assert any(words in line for line in wrong), words
