"""Slots as candidates, and the gain that each is expected to bring."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.screening import (
    all_parameter_paths,
    component_of,
    score_nonparametric_terms,
)
from ventbench.diagnosis.selection import fit_with_noise
from ventbench.physics import library, parameter
from ventbench.physics.catalogue import basis_terms
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS
from ventbench.system_id import Noise

from . import small

#: Without tails, so that sums of squares are all there is.
NOISE = Noise((0.2,), (0.0,), np.inf)


def test_every_basis_term_belongs_to_a_component():
    for name in basis_terms():
        assert name in NONPARAMETRIC_COMPONENTS[component_of(name)].terms
    assert component_of("sensor_memory") == component_of("drift_shape") == "measurement"


def test_all_paths_are_those_of_the_library_and_of_all_slots():
    found = all_parameter_paths()
    owners = {path.rpartition(".")[0] for path in found} - {""}
    assert owners == set(library()) | set(basis_terms())
    assert len(set(found)) == len(found)


def scanned(*effects, seed=0, **changed):
    evaluator = small.split(small.made(*effects, seed=seed, **changed), small.with_few())
    null = fit_with_noise(evaluator, Hypothesis())
    return evaluator, null, score_nonparametric_terms(null)


@pytest.mark.usefixtures("few_slots")
@pytest.mark.parametrize("change", [0.65, -0.65])
def test_resistance_that_follows_volume_is_found(change):
    effect = small.effect("volume_resistance", "R(V)", change=change)
    _, null, found = scanned(effect)
    assert {one.name for one in found} == set(small.FEW)
    assert found[0].name == "volume_resistance"
    assert max(found[0].nats, found[0].white) > 20.0
    best = [max(one.nats, one.white) for one in found]
    assert best == sorted(best, reverse=True)
    assert all(one.hypothesis == Hypothesis((one.name,)) for one in found)
    again = dataclasses.replace(null, hypothesis=Hypothesis((found[0].name,)))
    assert {one.name for one in score_nonparametric_terms(again)} == set(small.FEW) - {
        found[0].name
    }


@pytest.mark.usefixtures("few_slots")
def test_nothing_is_promised_where_nothing_is():
    *_, found = scanned(seed=3)
    # A slot has up to ten coefficients, each worth half a nat by chance.
    assert max(max(one.nats, one.white) for one in found) < 10.0


@pytest.mark.usefixtures("few_slots")
def test_promised_nats_are_what_a_refit_gains():
    effect = small.effect("turbulent_resistance", quadratic=1.0)
    evaluator = small.split(small.made(effect), small.with_few())
    null = evaluator.fit(Hypothesis(), NOISE, tolerance=1e-4, iterations=30)
    found = {one.name: one.nats for one in score_nonparametric_terms(null)}
    assert max(found, key=lambda name: found[name]) == "flow_shape"
    refitted = evaluator.fit(
        Hypothesis(("flow_shape",)), NOISE, null, iterations=30, tolerance=1e-4
    )
    # The cost has the prior of the coefficients in it, as the promise has.
    fallen = null.minimum.cost - refitted.minimum.cost
    assert fallen > 5.0
    assert found["flow_shape"] == pytest.approx(fallen, rel=0.15)
    first = next(path for path in refitted.problem.unknowns.paths if path.startswith("flow_shape"))
    assert np.ptp(refitted.column(first)) == 0.0
    assert refitted.column(first)[0] != parameter(first).neutral
