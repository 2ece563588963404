"""What an answer must be: whatever else comes is one clear error."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from proofs.challenge import contract
from proofs.challenge.contract import PLACES, TERMS, VOCABULARY, AnswerError, decode
from proofs.challenge.run import Limits, find, run

from .truths import SAMPLES, WITHHELD, answer, recording

COUNTS = dict.fromkeys(WITHHELD, SAMPLES)
DOCS = Path(__file__).parents[3] / "docs" / "diagnosers.md"


def good(**changed: Any) -> dict[str, Any]:
    full = answer(
        (0.7, "leak"),
        (0.2, ""),
        (0.1, "unknown:airway valve_lag"),
        parameters={"leak.conductance": {"value": 9.0, "low": 8.0, "high": 10}},
        active={"1": [[0.0, 0.5]]},
        record_next=[{"time": [0, 0.03], "u_in": [3, 4], "u_out": [0, 1]}],
        notes={"anything": [None]},
    )
    return full | changed


def hypotheses(*pairs: tuple[Any, Any]) -> dict[str, Any]:
    return good(hypotheses=[{"terms": terms, "probability": p} for terms, p in pairs])


def pressures(*values: Any) -> dict[str, Any]:
    return good(pressures=dict(zip(map(str, WITHHELD), values, strict=True)))


def parameters(path: str, **given: Any) -> dict[str, Any]:
    return good(parameters={path: {"value": 1.0, "low": 0.5, "high": 2.0} | given})


FLAT = [10.0] * SAMPLES
MALFORMED: list[tuple[Any, str]] = [
    (b"", "not an answer"),
    (b"\xff\xfe", "not an answer"),
    (b"{", "not an answer"),
    (b"[" * 100_000, "not an answer"),
    (b'{"hypotheses": NaN}', "not an answer"),
    (b'{"hypotheses": []} more', "not an answer"),
    (None, "Expected `object`"),
    ("nothing is missing", "Expected `object`"),
    ([], "Expected `object`"),
    ({}, "missing required field `hypotheses`"),
    ({"hypotheses": [], "pressures": {}}, "hypotheses has 0 entries"),
    ({k: v for k, v in good().items() if k != "pressures"}, "missing required field `pressures`"),
    (good(open_loop={"after": 0.0}), "unknown field `open_loop`"),
    (good(hypotheses={}), "Expected `array`"),
    (hypotheses(*[([], 0.002)] * 501), "hypotheses has 501 entries"),
    (hypotheses((["witchcraft"], 1.0)), "'witchcraft' is not in the vocabulary"),
    (hypotheses((["unknown:moon"], 1.0)), "'unknown:moon' is not in the vocabulary"),
    (hypotheses((["unknown"], 1.0)), "'unknown' is not in the vocabulary"),
    (hypotheses((["leak", "leak"], 1.0)), "each term once"),
    (hypotheses((sorted(TERMS)[:9], 1.0)), "8 at most"),
    (hypotheses((["leak", "cough"], 0.5), (["cough", "leak"], 0.5)), "earlier hypothesis"),
    (hypotheses((["leak"], 1.5)), "probability is 1.5"),
    (hypotheses((["leak"], -0.1), ([], 1.1)), "probability is -0.1"),
    (hypotheses((["leak"], None)), "got `null`"),
    (hypotheses((["leak"], "0.9")), "got `str`"),
    (hypotheses((["leak"], 0.5)), "sum to 0.5"),
    (hypotheses((["leak"], 0.9), ([], 0.9)), "sum to 1.8"),
    (hypotheses(("leak", 1.0)), "Expected `array`"),
    (good(pressures={"2": FLAT}), "breath 5 is withheld and has none"),
    (good(pressures={"2": FLAT, "5": FLAT, "6": FLAT}), "breath 6 is not withheld"),
    (good(pressures={"two": FLAT, "5": FLAT}), "Expected `int`"),
    (pressures(FLAT, FLAT[1:]), r"pressures\[5\] has 3 values; the breath has 4"),
    (pressures(FLAT, [*FLAT[1:], None]), "got `null`"),
    (pressures(FLAT, [*FLAT[1:], 1e9]), r"pressures\[5\] leaves"),
    (pressures(FLAT, 10.0), "Expected `array`"),
    (parameters("leak.colour"), "'leak.colour' is not in the vocabulary"),
    (parameters("leak.conductance", low=3.0), "not within its interval"),
    (parameters("R", high=None), "got `null`"),
    (good(parameters={"R": 20.0}), "Expected `object`"),
    (good(active={"1": [[0.5, 0.1]]}), r"active\[1\]: 0.5 to 0.1"),
    (good(active={"1": [[0.5]]}), "length 2"),
]


def test_forty_kinds_are_tried() -> None:
    assert len(MALFORMED) >= 40


@pytest.mark.parametrize(("given", "why"), MALFORMED, ids=[why for _, why in MALFORMED])
def test_a_malformed_answer_is_a_clear_error(given: Any, why: str) -> None:
    data = given if isinstance(given, bytes) else json.dumps(given).encode()
    with pytest.raises(AnswerError, match=why) as caught:
        decode(data, COUNTS)
    assert "\n" not in str(caught.value)


def test_a_good_answer_is_read() -> None:
    read = decode(json.dumps(good()).encode(), COUNTS)
    assert read.hypotheses[0].terms == ("leak",)
    assert read.pressures[5] == (20.0, 20.0, 6.0, 6.0)
    assert read.parameters["leak.conductance"].high == 10.0
    again = msgspec.json.encode(msgspec.to_builtins(read, str_keys=True))
    assert decode(again, COUNTS) == read


def test_every_name_has_a_place_and_a_strength() -> None:
    assert all(about.place in PLACES and about.parameters for about in VOCABULARY.values())


def test_the_library_is_in_the_vocabulary() -> None:
    from ventbench.physics.catalogue import library

    assert set(library()) <= set(VOCABULARY)


def test_the_example_of_the_docs_answers(tmp_path: Path) -> None:
    text = DOCS.read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.S)
    (manifest,) = re.findall(r"```toml\n(.*?)```", text, re.S)
    assert len(code.strip().splitlines()) <= 15
    assert len(text.split()) <= 500
    ast.parse(code)
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "diagnose.py").write_text(code)
    (folder / "diagnoser.toml").write_text(manifest)
    posed = tmp_path / "case"
    posed.mkdir()
    contract.pose(posed, recording(), WITHHELD, 60.0)
    outcome = run(find(str(folder)), posed, Limits(60.0, 4.0))
    assert outcome.problem == ""
    read = decode(outcome.answer, COUNTS)
    assert read.hypotheses[0].terms == ()
    assert read.pressures[2][0] == pytest.approx(20.0)
