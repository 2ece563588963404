"""Names beside a source that moves in time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from ventbench.diagnosis import refinement
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.selection import fit_with_noise

from . import small

NAMES = ("turbulent_resistance", "leak")


@pytest.fixture(scope="module")
def named():
    evaluator = small.split(
        small.made(
            small.effect("turbulent_resistance", quadratic=10.0),
            small.effect("leak", conductance=20.0),
        )
    )
    return evaluator, fit_with_noise(evaluator, Hypothesis(NAMES))


@pytest.mark.parametrize(("nats", "kept"), [(1.0, NAMES), (1e9, ())])
def test_a_source_takes_over_only_what_explains_less_than_itself(named, monkeypatch, nats, kept):
    evaluator, fitted = named

    def idle(evaluator, current, here, name):
        return 0.0, evaluator.fit(current.hypothesis.without(name), current.noise, current), here

    monkeypatch.setattr(refinement, "_idle", idle)
    place: Any = SimpleNamespace(nats=nats, source=SimpleNamespace(source="f(t) at the supply"))
    assert refinement.eliminate_beside_input(evaluator, fitted, place).names == kept
