from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import get_args

import numpy as np
import pytest

from hardware_eval.emulation.cases import LIBRARY
from proofs.challenge.first.plan import CLASSES, OUTSIDE
from proofs.challenge.generators import FIRST
from proofs.challenge.questions import Kind
from proofs.challenge.truth import has_library_form
from ventbench.base.errors import InputError
from ventbench.physics import library


def drawn(kind, count, seed=0):
    return FIRST.draw(kind, count, np.random.default_rng(seed))


def test_effects_inside_the_library_have_its_names():
    assert set(LIBRARY) <= set(library())
    assert len(OUTSIDE) == 7


def test_the_whole_grid_is_drawn_evenly():
    cells = Counter(
        (d.case.effects[0].name, d.case.effects[0].strength, d.case.lung)
        for d in drawn("single", 204)
    )
    assert len(cells) == 204
    assert set(cells.values()) == {1}
    part = drawn("single", 51)
    assert set(Counter(d.case.effects[0].name for d in part).values()) == {3}
    strengths = Counter(d.case.effects[0].strength for d in part)
    assert abs(strengths["mild"] - strengths["strong"]) < 18


def test_all_kinds_are_there_and_mixed():
    cases = drawn("all", 60)
    assert len(cases) == 60
    assert {d.kind for d in cases} == set(get_args(Kind))
    kinds = [d.kind for d in cases]
    assert sum(a == b for a, b in pairwise(kinds)) < 35


def test_company_is_of_different_classes():
    for d in drawn("four", 40):
        names = {item.name for item in d.case.effects}
        assert len(names) == 4
        assert all(item.strength == "strong" for item in d.case.effects)
        assert all(len(names & group) <= 1 for group in CLASSES)
    assert {len(d.case.effects) for d in drawn("pair", 10)} == {2}


def test_other_forms_are_not_the_librarys():
    cases = drawn("form", 60)
    assert not any(has_library_form(d.case.effects[0]) for d in cases)
    assert {"linear", "two lags", "sigmoid", "soft play"} <= {d.case.effects[0].form for d in cases}


def test_nulls_and_masked_cases():
    nulls = drawn("null", 60)
    assert all(not d.case.effects for d in nulls)
    assert {d.case.log_step for d in nulls} == {0.01, 1.0}
    assert {d.case.jitter for d in nulls} == {3e-4, 1e-3}
    assert max(d.case.coloured for d in nulls) > 0.4
    masked = drawn("masked", 60)
    assert {d.case.noise for d in masked} == {0.1, 0.2, 0.3}
    assert {d.case.style for d in masked} == {"pi"}
    assert all(8 <= d.case.breaths <= 15 for d in masked)


def test_rigs_are_off_their_labels():
    bases = [(d.case.base, d.case) for d in drawn("null", 60)]
    off = np.array([(b.R / c.lung_R, b.C / c.lung_C, b.gain / 22.8) for b, c in bases if b])
    assert np.all(np.abs(off - 1) <= [0.15, 0.07, 0.1])
    assert np.all(np.abs(off - 1).max(axis=0) > [0.12, 0.05, 0.08])


def test_the_same_seed_draws_the_same():
    assert drawn("all", 30, 4) == drawn("all", 30, 4)
    assert drawn("all", 30, 4) != drawn("all", 30, 5)


def test_too_few_for_all_kinds():
    with pytest.raises(InputError, match="too few"):
        drawn("all", 3)
