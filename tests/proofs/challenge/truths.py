"""Answers made up for a known truth, and diagnosers that run in processes of their own."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from hardware_eval.emulation.cases import Base, Case, Effect
from proofs.challenge.folder import Withheld
from proofs.challenge.judge import JudgedCase, judge
from proofs.challenge.questions import DrawnCase
from ventbench.recordings.breaths import Breaths, make_breaths

#: Withheld breaths and samples of the made-up recording.
WITHHELD, SAMPLES = (2, 5), 4


def case(*effects: Effect, **changed: Any) -> Case:
    """A rig with the nominal gain."""
    given = {"base": Base(10.0, 20.0), "noise": 0.0, "step": 0.0, "breaths": 6} | changed
    return Case("case_0001", 10.0, 20.0, effects, **given)


def drawn(kind: Any, *effects: Effect) -> DrawnCase:
    return DrawnCase(kind, case(*effects))


def recording() -> Breaths:
    """Six breaths of four samples; half of each is an inspiration at 20 cmH2O, the rest at 6."""
    time = np.tile(np.arange(SAMPLES) * 0.5, (6, 1))
    u_out = (time >= 1.0).astype(np.int8)
    pressure = np.where(u_out == 0, 20.0, 6.0)
    pressure[np.isin(np.arange(1, 7), WITHHELD)] = np.nan
    ones = np.ones(6)
    return make_breaths(
        np.arange(1, 7), 10 * ones, 20 * ones, time, 10.0 * (1 - u_out), u_out, pressure
    )


def withheld(**changed: Any) -> Withheld:
    return Withheld({breath: (20.0, 20.0, 6.0, 6.0) for breath in WITHHELD}, **changed)


def answer(*hypotheses: tuple[float, str], **changed: Any) -> dict[str, Any]:
    """An answer; hypotheses as probability and terms with blanks between, ``""`` for nothing."""
    return {
        "hypotheses": [{"terms": terms.split(), "probability": p} for p, terms in hypotheses],
        "pressures": {str(breath): [20.0, 20.0, 6.0, 6.0] for breath in WITHHELD},
    } | changed


def answered(given: dict[str, Any] | None, **changed: Any) -> dict[str, Any]:
    """The file of an answer; None for a lost case."""
    return {
        "recording_sha256": "",
        "seconds": 10.0,
        "peak_mib": 500.0,
        "code": "",
        "layers": [],
        "problem": "" if given else "failed",
        "answer": given,
    } | changed


def judged(
    kind: Any,
    effects: list[Effect],
    given: dict[str, Any] | None,
    worth: float = 100.0,
    kept: Withheld | None = None,
    **changed: Any,
) -> JudgedCase:
    nats = (worth,) * len(effects)
    file = answered(given, **changed)
    return judge(drawn(kind, *effects), nats, recording(), kept or withheld(), file)


def _flat(folder: Path, terms: list[str]) -> dict[str, Any]:
    """Answer with certainty, and with a constant pressure."""
    question = json.loads((folder / "case.json").read_text())
    header, *rows = (line.split(",") for line in (folder / "recording.csv").read_text().split())
    numbers = [int(row[header.index("breath_id")]) for row in rows]
    return {
        "hypotheses": [{"terms": terms, "probability": 1.0}],
        "pressures": {str(b): [10.0] * numbers.count(b) for b in question["withheld"]},
    }


def sees_nothing(folder: Path) -> dict[str, Any]:
    return _flat(folder, [])


def unsure(folder: Path) -> dict[str, Any]:
    """Is not sure."""
    return _flat(folder, ["leak"]) | {
        "hypotheses": [
            {"terms": ["leak"], "probability": 0.6},
            {"terms": [], "probability": 0.4},
        ],
    }


def fails(folder: Path) -> None:
    raise ValueError("no idea")


def answers_text(folder: Path) -> str:
    return "nothing is missing"


def never_ends(folder: Path) -> None:
    while True:
        pass


def eats_memory(folder: Path) -> Any:
    return np.ones(1 << 38)


def kills_itself(folder: Path) -> None:
    os.kill(os.getpid(), 6)
