"""Small recordings of concealed effects, of equal size, so that compiled functions serve again.

The rig of the challenge shares no code with what is fitted.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from ventbench.diagnosis.evaluator import Evaluator, make_evaluator
from ventbench.diagnosis.settings import DataSettings, SelectionConfig
from ventbench.physics import library, paths
from ventbench.physics.catalogue import basis_terms
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import recorded
from ventbench.validation.challenge.cases import Base, Case, Effect
from ventbench.validation.challenge.rig import record

#: The lung as it is labelled, and the rig as it is.
LABEL, RIG = "R20C20", Base(21.0, 19.5)

#: One size of array for training, judging and all breaths.
BREATHS, SAMPLES = 16, 40
HELD = np.arange(BREATHS) % 2 == 1

#: One compilation for all of these breaths.
SETTINGS = SelectionConfig(data=DataSettings(batch_size=BREATHS))

#: A few elements of slots, whose derivatives take a quarter of the time to compile.
FEW = ("volume_resistance", "flow_shape")


def effect(name: str, form: str = "library", /, **parameters: float) -> Effect:
    return Effect(name, "strong", form, parameters)


def made(*effects: Effect, seed: int = 0, **changed: Any) -> Breaths:
    """Recorded breaths; ``changed`` are fields of a case."""
    given = {"base": RIG, "breaths": BREATHS, "samples": SAMPLES, "noise": 0.2} | changed
    one = Case("", 20.0, 20.0, effects, **given)
    return record(one, np.random.default_rng(seed), steps=16)


def split(breaths: Breaths, names: tuple[str, ...] | None = None) -> Evaluator:
    """On the bench, with the library's parameters or some."""
    return make_evaluator(
        recorded(breaths), HELD[: len(breaths)], names or paths(), settings=SETTINGS
    )


def with_few() -> tuple[str, ...]:
    """Parameters of the library and of a few slots."""
    return paths((*library(), *FEW))


def limit_slots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave a few slots to choose from."""
    few = {name: basis_terms()[name] for name in FEW}
    monkeypatch.setattr("ventbench.diagnosis.screening.basis_terms", lambda: few)
    monkeypatch.setattr("ventbench.diagnosis.found.all_parameter_paths", with_few)


def numbered(breaths: Breaths, first: int) -> Breaths:
    """The same with ids from ``first``, so that recordings can be joined."""
    return dataclasses.replace(breaths, breath_id=first + np.arange(len(breaths)))
