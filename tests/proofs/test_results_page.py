"""Sections of the page of results."""

from __future__ import annotations

from pathlib import Path

import pytest

from hardware_eval.emulation.cases import Effect
from proofs import code_version
from proofs.challenge.figures import Figure
from proofs.challenge.judge import judge
from proofs.challenge.reveal import ChallengeResult, Draw
from proofs.real.rig import Claim, Proof
from proofs.results_page import (
    challenge_section,
    proof_section,
    write_section,
)
from tests.proofs.challenge.truths import answer, drawn, mechanism
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


def test_a_challenge_tells_its_seed_its_commitment_and_its_code() -> None:
    leak = Effect("leak", "strong", "library", {"conductance": 20.0})
    right = judge(drawn("single", leak), [100.0], answer("named", mechanism("leak")))
    wrong = judge(
        drawn("single", leak), [0.1], answer("named", mechanism("valve_lag"), slot="f(V)")
    )
    result = ChallengeResult(
        (Draw("abc123", 40, 1), Draw("def456", 8, 1)), ("case_0003",), (right, wrong), (
            Figure("strong: right name", 0.9, ">= 98%", 20, (0.7, 0.97), False),
            Figure("seconds a case, median", 5.25, "", 20, None, None),
            Figure("nothing missing: false names", None, "<= 0%", 0, None, None),
        ),
        {"leak": {"leak": 5, **{f"name {k}": 1 for k in range(8)}}}, {}, ("1a2b3c",), "stranger",
    )  # fmt: skip
    text = challenge_section(result, ["words", "-more"])
    make = "python -m proofs challenge make --generator stranger"
    assert f"{make} --seed=words --cases 40 --out runs/strangers\n" in text
    assert f"{make} --seed=-more --cases 8 --out runs/strangers2\n" in text
    both = "runs/strangers runs/strangers2 --seed=words --seed=-more"
    assert f"python -m proofs challenge reveal {both}\n" in text
    assert "Generator `stranger`, code 1a2b3c:\n" in text
    assert "| `words` | `abc123` | 1 of 40 |\n| `-more` | `def456` | 1 of 8 |" in text
    same = challenge_section(result, ["words", "words"])  # with other numbers of cases
    assert "| `words` | `abc123` | 1 of 40 |\n| `words` | `def456` | 1 of 8 |" in same
    assert "Answers that are not right (1 of 2):" in text
    assert (
        "| single | R10C20 | leak (strong, below the detection limit) | valve_lag + f(V) | "
        "1.00, 0.60, 0.30 |"
    ) in text
    assert "| strong: right name | 90% (70–97) | 20 | >= 98%, missed |" in text
    assert "\nWithout a goal: seconds a case, median 5.25.\n" in text
    assert "false names" not in text  # there was no case


def test_the_proof_is_told_part_by_part_and_lung_by_lung() -> None:
    estimate = {"value": 0.032, "unit": "s", "ci95": [0.028, 0.036]}
    stages = {name: {"mae": mae, "rmse": mae} for name, mae in
              (("before", 5.0), ("refit", 3.0), ("after", 1.5))}  # fmt: skip
    part = {
        "held_out": 29, "mae": {"before": 5.0, "refit": 3.0, "after": None}, "cut_percent": 70.0,
        "mechanisms": [{"name": "valve_delay", "parameters": {"delay": estimate}}],
        "slot": None, "groups": {"lung R5C10": stages, "expiration": stages}, "code": "1a2b3c",
    }  # fmt: skip
    proof = Proof("f" * 64, {"rc": part}, {"injected": "no file"}, (Claim("rc", "w", "v", True),))
    text = proof_section(proof)
    assert "Code 1a2b3c, recording `ffffffffffffffff`" in text
    assert "| `rc` | 29 | 5.00 | 3.00 | – | 70 % | `valve_delay` |" in text
    assert "| R5C10 | 5.00 | 3.00 | 1.50 |" in text
    assert "expiration" not in text
    assert "| `valve_delay` delay | 0.032 s | 0.028 to 0.036 |" in text
    assert "| `rc` | w | v | yes |" in text
    assert "| `injected` | – | no file | |" in text


def test_the_code_is_known() -> None:
    assert code_version()
