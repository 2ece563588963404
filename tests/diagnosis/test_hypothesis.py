"""The algebra of hypotheses."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ventbench.diagnosis.hypothesis import Hypothesis, varies_by_breath
from ventbench.physics import library
from ventbench.system_id import START

NAMES = sorted(library())
SHAPES = ["leak.exponent", "valve_curve.power", "supply_droop.recovery", "viscoelasticity.time"]
BASE = ("R", "C", "R_ex", "PEEP")

hypotheses = st.builds(
    lambda names, free, fixed: Hypothesis(tuple(names), tuple(free), tuple(fixed.items())),
    st.lists(st.sampled_from(NAMES), unique=True, max_size=4),
    st.lists(st.sampled_from(SHAPES), unique=True, max_size=3),
    st.dictionaries(st.sampled_from(SHAPES), st.sampled_from([0.5, 1.0]), max_size=2),
)


@given(hypotheses, hypotheses)
def test_a_union_keeps_the_order_and_names_no_term_twice(one, other):
    both = one.plus(other)
    assert both.names[: len(one.names)] == one.names
    assert len(set(both.names)) == len(both.names)
    assert set(both.names) == {*one.names, *other.names}
    assert set(both.free) == {*one.free, *other.free}
    assert dict(both.fixed) == dict(one.fixed) | dict(other.fixed)


@given(hypotheses)
def test_nothing_added_changes_nothing(one):
    assert one.plus(Hypothesis()) == one
    assert Hypothesis().plus(one) == one
    assert one.plus(one) == one
    assert one.minus() == one


@given(hypotheses, st.sampled_from(NAMES))
def test_without_a_term_all_its_parameters_are_gone(one, name):
    left = one.minus(name)
    assert name not in left.names
    owned = (*left.paths, *left.free, *dict(left.fixed))
    assert not [path for path in owned if path.startswith(f"{name}.")]
    assert left.minus(name) == left
    assert set(one.names) - set(left.names) <= {name}
    kept = {path for path in one.free if not path.startswith(f"{name}.")}
    assert set(left.free) == kept


@given(hypotheses)
def test_fixed_parameters_are_not_fitted_and_base_parameters_always_are(one):
    assert not set(one.paths) & set(dict(one.fixed))
    assert {*BASE, START} <= set(one.paths)
    assert len(set(one.paths)) == len(one.paths)
    for path in one.free:
        assert path in one.paths or path in dict(one.fixed)


def test_shape_parameters_are_fitted_only_if_freed():
    assert Hypothesis(("leak",)).paths == (*BASE, "leak.conductance", START)
    free = Hypothesis(("leak",), ("leak.exponent",))
    assert free.paths == (*BASE, "leak.conductance", START, "leak.exponent")
    fixed = Hypothesis(("leak",), ("leak.exponent",), (("leak.exponent", 1.0),))
    assert fixed.paths == Hypothesis(("leak",)).paths


def test_only_patient_effort_varies_by_breath():
    assert [name for name in NAMES if varies_by_breath(name)] == ["patient_effort"]
