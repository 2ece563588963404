"""Answers made up for a known truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hardware_eval.emulation.cases import Base, Case, Effect
from proofs.challenge.questions import DrawnCase


def case(*effects: Effect, **changed: Any) -> Case:
    """A rig with the nominal gain."""
    given = {"base": Base(10.0, 20.0), "noise": 0.0, "step": 0.0, "breaths": 6} | changed
    return Case("case_0001", 10.0, 20.0, effects, **given)


def drawn(kind: Any, *effects: Effect) -> DrawnCase:
    return DrawnCase(kind, case(*effects))


def mechanism(name: str, *alternatives: str, **parameters: tuple[float, float, float]) -> Any:
    """A named mechanism; parameters as value, low, high."""
    return {
        "name": name,
        "parameters": {
            key: {"value": value, "unit": "", "ci95": [low, high]}
            for key, (value, low, high) in parameters.items()
        },
        "alternatives": list(alternatives),
    }


def answer(
    verdict: str, *mechanisms: Any, slot: str | None = None, form: str | None = None, **changed: Any
) -> Any:
    """The file of an answer."""
    rmse = {stage: {"mae": 0.0, "rmse": x} for stage, x in
            (("before", 1.0), ("refit", 0.6), ("after", 0.3))}  # fmt: skip
    return {
        "recording_sha256": "",
        "seconds": 10.0,
        "peak_mib": 500.0,
        "first_in_process": False,
        "diagnosis": {
            "verdict": verdict,
            "mechanisms": list(mechanisms),
            "slot": None if slot is None else {"name": slot},
            "form": None if form is None else {"name": form},
            "open_loop": rmse | {"held_out_breaths": [1, 2]},
        },
    } | changed


@dataclass(frozen=True, eq=False)
class Commands:
    """A request of two breaths."""

    u_in: Any
    u_out: Any
    dt: Any


@dataclass(frozen=True, eq=False)
class GivenDiagnosis:
    """A diagnosis."""

    value: Any
    request: Commands | None = None

    def as_dict(self) -> Any:
        return self.value


def request(samples: int = 80) -> Commands:
    u_in = np.zeros((2, samples))
    u_in[:, :20] = [[5.0], [8.0]]
    u_out = np.zeros((2, samples))
    u_out[:, 50:] = 1.0
    return Commands(u_in, u_out, np.full((2, samples), 0.033))


def sees_nothing(breaths: Any, lung: str) -> GivenDiagnosis:
    """A diagnosis that another process can be asked for."""
    return GivenDiagnosis(answer("nothing_missing")["diagnosis"])
