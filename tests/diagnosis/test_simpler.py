"""One shape, or a sum of names that imitates it."""

from __future__ import annotations

import pytest

from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.refinement import SingleTermAlternative
from ventbench.diagnosis.selection import fit_with_noise

from . import small

SUM = Hypothesis(("turbulent_resistance", "viscoelasticity", "leak"))


@pytest.fixture
def few(monkeypatch):
    small.limit_slots(monkeypatch)


def one_shape(breaths):
    narrow = small.split(breaths)
    null = fit_with_noise(narrow, Hypothesis())
    return (
        narrow,
        null,
        SingleTermAlternative(narrow, lambda: small.split(breaths, small.with_few()), null),
    )


def test_names_that_imitate_a_shape_give_way(few):
    effect = small.effect("volume_resistance", "R(V)", change=0.65)
    narrow, null, simpler = one_shape(small.made(effect, noise=0.1))
    assert simpler(fit_with_noise(narrow, Hypothesis(SUM.names[:2]))) is None  # too few to ask
    assert simpler(fit_with_noise(narrow, SUM)) is null


def test_names_that_act_stay(few):
    narrow, _, simpler = one_shape(
        small.made(
            small.effect("turbulent_resistance", quadratic=10.0),
            small.effect("leak", conductance=20.0),
            small.effect("viscoelasticity", ratio=0.7, time=1.0),
            noise=0.1,
        )
    )
    assert simpler(fit_with_noise(narrow, SUM)) is None
