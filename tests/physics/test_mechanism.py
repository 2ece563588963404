"""Mechanisms that are off are skipped, and nothing else changes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.physics import library, mechanism, parameter, paths
from ventbench.physics.catalogue import basis_terms
from ventbench.physics.mechanism import apply_if_active, is_active
from ventbench.physics.model import Physics
from ventbench.system_id import START, Predictor, make_data, parameter_values

from . import cases

NAMES = paths((*library(), *basis_terms()))


@pytest.fixture(scope="module")
def data():
    return make_data(cases.recording(6, {}))


@pytest.fixture(scope="module")
def skipping(data):
    return Predictor(data, NAMES)


@pytest.fixture(scope="module")
def whole(data):
    predictor = Predictor(data, NAMES)
    predictor._static["skip_idle"] = False
    return predictor


@pytest.fixture(scope="module")
def off(data):
    return parameter_values(data, NAMES, {"PEEP": 5.0})


def of_strength(name):
    item = parameter(name)
    return item.strong if item.strong != item.neutral else item.high


@pytest.mark.parametrize("name", [*library(), *basis_terms()])
def test_one_that_acts_alone_acts_as_among_all(skipping, whole, off, name):
    """Through any of its coefficients: the first is not the whole strength of a basis term."""
    item = mechanism(name)
    moved = item.description.parameters[: 1 if name in library() else None]
    changes = []  # a knot of a curve may lie beyond these data
    for one in moved:
        values = off.copy()
        values[:, NAMES.index(f"{name}.{one.name}")] = of_strength(f"{name}.{one.name}")
        seen = skipping.predict(values)
        np.testing.assert_allclose(seen, whole.predict(values), rtol=0, atol=1e-10)
        changes.append(np.abs(seen - skipping.predict(off)).max())
    assert np.sum(np.array(changes) > 1e-3) >= min(len(moved), 2)


def test_all_at_once_and_none(skipping, whole, off):
    mild = off.copy()
    for name in library():
        strength = library()[name].description.strength
        mild[:, NAMES.index(f"{name}.{strength.name}")] = strength.mild
    for values in (off, mild):
        there, other = skipping.predict(values), whole.predict(values)
        np.testing.assert_allclose(there, other, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_what_acts_in_one_breath_of_one_point_is_not_skipped(skipping, whole, off):
    points = np.stack([off, off, off])
    points[1, 4, NAMES.index("patient_effort.amplitude")] = 5.0
    seen = skipping.predict_all(points)
    np.testing.assert_allclose(seen, whole.predict_all(points), rtol=0, atol=1e-10)
    changed = np.abs(seen - seen[0]).max(axis=(2, 3)) > 0.1
    assert np.argwhere(changed).tolist() == [[1, 4]]


@pytest.mark.slow
def test_slopes_at_neutral_are_those_of_the_whole_model(skipping, whole, off):
    order = (*NAMES, START)
    columns = tuple(order.index(f"{n}.{m.description.strength.name}") for n, m in library().items())
    slopes = skipping.derivatives(off, columns)[1]
    np.testing.assert_allclose(slopes, whole.derivatives(off, columns)[1], rtol=1e-5, atol=1e-4)


@pytest.mark.slow
def test_without_skipping_idle_strengths_have_slopes():
    def pressure(strength, skip):
        plant = Physics((), (), skip_idle=skip).having(R=20.0, C=20.0)
        plant = plant.having(**{"leak.conductance": strength})
        state, _ = plant.init(jnp.asarray(5.0), jnp.asarray(5.0))
        return plant.step(state, jnp.asarray(30.0), jnp.asarray(0), jnp.asarray(0.03))[1].reading

    assert float(jax.grad(pressure)(0.0, False)) < -0.01
    assert float(jax.grad(pressure)(0.0, True)) == 0.0
    assert float(pressure(8.0, True)) == pytest.approx(float(pressure(8.0, False)))


def test_only_what_changes_passes_the_branch():
    before = {"changed": jnp.ones(3), "kept": jnp.ones(4)}

    def change(x):
        return x | {"changed": 2.0 * x["changed"]}

    (branch,) = [
        eqn
        for eqn in jax.make_jaxpr(lambda on: apply_if_active(on, change, before))(True).eqns
        if eqn.primitive.name == "cond"
    ]
    assert [v.aval.shape for v in branch.outvars] == [(3,)]
    on, off = (apply_if_active(jnp.asarray(x), change, before) for x in (True, False))
    assert on["changed"].tolist() == [2.0] * 3
    assert off["changed"].tolist() == [1.0] * 3
    assert on["kept"].tolist() == off["kept"].tolist() == [1.0] * 4


def test_acts_if_any_parameter_is_moved_anywhere():
    item = library()["valve_curve"]
    neutral = {p.name: jnp.full((2, 3), p.neutral) for p in item.description.parameters}
    assert not bool(is_active(item, neutral))
    for name, values in neutral.items():
        assert bool(is_active(item, neutral | {name: values.at[1, 2].add(0.1)}))
