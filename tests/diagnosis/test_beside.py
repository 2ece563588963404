"""Names beside a source that moves in time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from ventbench.diagnosis import beside
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.steps import settle

from . import small

NAMES = ("turbulent_resistance", "leak")


@pytest.fixture(scope="module")
def named():
    bench = small.split(
        small.made(
            small.effect("turbulent_resistance", quadratic=10.0),
            small.effect("leak", conductance=20.0),
        )
    )
    return bench, settle(bench, Hypothesis(NAMES))


@pytest.mark.parametrize(("nats", "kept"), [(1.0, NAMES), (1e9, ())])
def test_a_source_takes_over_only_what_explains_less_than_itself(named, monkeypatch, nats, kept):
    bench, solved = named

    def idle(bench, current, here, name):
        return 0.0, bench.solve(current.hypothesis.without(name), current.noise, current), here

    monkeypatch.setattr(beside, "_idle", idle)
    place: Any = SimpleNamespace(nats=nats, source=SimpleNamespace(source="f(t) at the supply"))
    assert beside.beside_source(bench, solved, place).names == kept
