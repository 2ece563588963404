"""A second name that only bends the first one's form is dropped; one that acts stays."""

from __future__ import annotations

import pytest

from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.refinement import drop_compensating_terms
from ventbench.diagnosis.selection import fit_with_noise
from ventbench.physics import library, paths
from ventbench.physics.catalogue import basis_terms

from . import small

BOTH = Hypothesis(("leak", "viscoelasticity"))


@pytest.fixture
def only_leaks(monkeypatch):
    one = {"leak_shape": basis_terms()["leak_shape"]}
    monkeypatch.setattr("ventbench.diagnosis.screening.basis_terms", lambda: one)


def left(*effects):
    breaths = small.made(*effects, noise=0.1, seed=2)
    evaluator = small.split(breaths)
    wide = small.split(breaths, paths((*library(), "leak_shape")))
    said: list[str] = []
    named = drop_compensating_terms(evaluator, wide, fit_with_noise(evaluator, BOTH), said.append)
    assert said
    return named


@pytest.mark.usefixtures("only_leaks")
def test_a_name_that_bends_anothers_form_is_dropped():
    """A linear leak is no root, and a viscous lung makes up for that."""
    named = left(small.effect("leak", "linear", conductance=20.0))
    assert named.hypothesis.names == ("leak",)


@pytest.mark.usefixtures("only_leaks")
def test_two_that_act_both_stay():
    named = left(
        small.effect("leak", conductance=20.0),
        small.effect("viscoelasticity", ratio=0.7, time=1.0),
    )
    assert named.hypothesis.names == BOTH.names


def test_a_single_name_trims_nothing(plain):
    one = plain.evaluator.fit(Hypothesis(("leak",)), plain.null.noise, plain.null, iterations=1)
    said: list[str] = []
    assert drop_compensating_terms(plain.evaluator, plain.evaluator, one, said.append) is one
    assert not said
