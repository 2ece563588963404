"""Sections of the page of results."""

from __future__ import annotations

from pathlib import Path

import pytest

from hardware_eval.emulation.cases import Effect
from proofs import code_version
from proofs.challenge import reveal
from proofs.challenge.figures import Figure, by_kind
from proofs.challenge.reveal import Board, Draw, Judged
from proofs.real.rig import Claim, Proof
from proofs.results_page import (
    board_section,
    challenge_section,
    proof_sections,
    write_section,
)
from tests.proofs.challenge.truths import answer, judged
from ventbench.base.errors import InputError


def test_a_section_is_replaced_and_the_rest_stays(tmp_path: Path) -> None:
    page = tmp_path / "results.md"
    page.write_text("before\n\n<!-- proof -->\nold\n<!-- end proof -->\n\nafter\n")
    write_section(page, "proof", "| new |\n")
    assert page.read_text() == (
        "before\n\n<!-- proof -->\n\n| new |\n\n<!-- end proof -->\n\nafter\n"
    )
    write_section(page, "proof", "newer")
    assert "| new |" not in page.read_text()
    with pytest.raises(InputError, match="no section between <!-- challenge first -->"):
        write_section(page, "challenge first", "text")
    write_section(tmp_path / "fresh.md", "proof", "text")
    assert (tmp_path / "fresh.md").read_text().startswith("<!-- proof -->")


def test_a_challenge_tells_its_code_and_its_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    leak = Effect("leak", "strong", "library", {"conductance": 20.0})
    right = judged("single", [leak], answer((1.0, "leak")))
    wrong = judged("single", [leak], answer((0.9, "unknown:lung valve_lag"), (0.1, "")), worth=0.1)
    result = Judged(
        "refit",
        "stranger",
        (Draw("words", "abc123", 40, 1), Draw("-more", "def456", 8, 1)),
        {(0, "case_0001"): right, (1, "case_0001"): wrong},
        ("case_0003",),
        ("1a2b3c",),
    )
    more = (
        Figure("strong: more", 0.9, ">= 98%", 20, (0.7, 0.97), False, True),
        Figure("seconds a case, median", 5.25, "", 20, None, None),
        Figure("another score", 0.51, "", 20, (0.4, 0.625), None),
        Figure("nothing missing: false", None, "<= 0%", 0, None, None, True),
    )
    monkeypatch.setattr(reveal, "by_kind", lambda cases: (*by_kind(cases), *more))
    text = challenge_section(result)
    assert "Diagnoser `refit`, code 1a2b3c, answered 1 of 40, 1 of 8 of `stranger`:\n" in text
    assert "Answers that are not right (1 of 2):" in text
    told = "unknown:lung + valve_lag | strong leak (below the detection limit)"
    assert f"| {told} |" in text
    assert "| strong: more | 90% (70%..97%) | 20 | >= 98%, missed |" in text
    assert "seconds a case, median 5.25; another score 0.51 (0.4..0.625)." in text
    assert "false |" not in text  # there was no case


def test_the_board_has_a_column_and_a_difference_for_each() -> None:
    leak = Effect("leak", "strong", "library", {"conductance": 20.0})
    ours = {(0, str(k)): judged("single", [leak], answer((1.0, "leak"))) for k in range(5)}
    other = {(0, str(k)): judged("single", [leak], answer((1.0, ""))) for k in range(3)}
    draws = (Draw("words", "abc123", 5, 5), Draw("-more", "def456", 8, 0))
    rows = (Judged("ours", "faults", draws, ours), Judged("flat", "faults", draws, other))
    text = board_section(Board("ours", {"faults": rows}))
    assert "\n| `faults` | ours | – | 5 | 0 (0..0) | 1 (1..1) |" in text
    assert "\n| `faults` | flat | – | 3 | 6.91 (6.91..6.91) | 0 (0..0) |" in text
    assert text.endswith(" | -6.91 (-6.91..-6.91) | -1 (-1..-1) |")
    assert text.count("| ours |") == 1
    assert "| `faults` | `words` | `abc123` |\n| `faults` | `-more` | `def456` |" in text
    make, both = "python -m proofs challenge make --generator faults", "runs/faults runs/faults2"
    assert f"{make} --seed=words --cases 5 --out runs/faults\n" in text
    assert f"{make} --seed=-more --cases 8 --out runs/faults2\n" in text
    assert f"for where in {both}; do for who in ours flat; do python -m proofs" in text
    assert text.count(f"challenge board {both} --seed=words --seed=-more\n") == 1


def test_the_proof_is_told_part_by_part_and_lung_by_lung() -> None:
    estimate = {"value": 0.032, "unit": "s", "ci95": [0.028, 0.036]}
    stages = {
        name: {"mae": mae, "rmse": mae}
        for name, mae in (("before", 5.0), ("refit", 3.0), ("after", 1.5))
    }
    part = {
        "held_out": 29,
        "mae": {"before": 5.0, "refit": 3.0, "after": None},
        "cut_percent": 70.0,
        "mechanisms": [{"name": "valve_delay", "parameters": {"delay": estimate}}],
        "slot": None,
        "groups": {"lung R5C10": stages, "expiration": stages},
        "code": "1a2b3c",
    }
    proof = Proof("f" * 64, {"rc": part}, {"injected": "no file"}, (Claim("rc", "w", "v", True),))
    sections = proof_sections(proof)
    assert list(sections) == ["proof rc", "proof injected"]
    text = sections["proof rc"]
    assert "Code 1a2b3c, recording `ffffffffffffffff`" in text
    assert "| 29 | 5.00 | 3.00 | – | 70 % | `valve_delay` |" in text
    assert "| R5C10 | 5.00 | 3.00 | 1.50 |" in text
    assert "expiration" not in text
    assert "| `valve_delay` delay | 0.032 s | 0.028 to 0.036 |" in text
    assert "| w | v | yes |" in text
    assert sections["proof injected"].endswith("no file")


def test_the_code_is_known() -> None:
    assert code_version()
