"""What the tests of naming share: one recording without any effect, fitted once."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.selection import fit_with_noise

from . import small


class Plain(NamedTuple):
    """A recording in which nothing is missing."""

    evaluator: Evaluator
    null: FittedModel


@pytest.fixture(scope="session")
def plain() -> Plain:
    evaluator = small.split(small.made())
    return Plain(evaluator, fit_with_noise(evaluator, Hypothesis()))


@pytest.fixture
def few_slots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave a few slots to choose from, since all of them take a minute to compile."""
    small.limit_slots(monkeypatch)
