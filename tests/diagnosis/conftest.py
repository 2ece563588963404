"""A recording without any effect, fitted once for all tests."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from ventbench.diagnosis.evaluator import Evaluator, fit_with_noise
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis

from . import small


class Plain(NamedTuple):
    """A recording in which nothing is missing, and the base model."""

    evaluator: Evaluator
    base: FittedModel


@pytest.fixture(scope="session")
def plain() -> Plain:
    evaluator = small.split(small.made())
    return Plain(evaluator, fit_with_noise(evaluator, Hypothesis()))


@pytest.fixture(scope="session")
def turbulent() -> Evaluator:
    """A recording with one strong effect."""
    return small.split(small.made(small.effect("turbulent_resistance", quadratic=10.0)))


@pytest.fixture(scope="session")
def both(turbulent) -> tuple[FittedModel, FittedModel]:
    """The recording's mechanism, fitted with its noise, and the base model at this noise."""
    named = fit_with_noise(turbulent, Hypothesis(("turbulent_resistance",)))
    return named, turbulent.fit(Hypothesis(), named.noise, named)
