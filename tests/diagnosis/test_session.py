"""Faults of the recording and of the session: clocks, steps and drifts, and gas that is trapped.

The rigs share no code with what is fitted: that of the challenge, and the oracle of the physics.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.physics import cases
from ventbench.base.interval import Interval
from ventbench.diagnosis.diagnose import diagnose
from ventbench.diagnosis.evaluator import fit_with_noise
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.identification import first_after, place_of_change
from ventbench.recordings import join
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Noise, make_data

from . import small

#: Breaths before a step; the training breaths on either side are the seventh and the ninth.
BEFORE = 7
STEPS = {
    "gain_step": ({"gain": 1.25}, 0.25),
    "resistance_step": ({"R": 1.5}, 0.5),
    "compliance_step": ({"C": 0.75}, -0.25),
    "zero_step": ({}, 1.5),
}


def changing(factors: np.ndarray, name: str) -> Breaths:
    """Breaths of rigs of which a base parameter is multiplied by a factor of each breath's own."""
    rigs: dict[float, Breaths] = {}
    for factor in np.unique(factors):
        changed = dataclasses.replace(small.RIG, **{name: factor * getattr(small.RIG, name)})
        rigs[factor] = small.made(base=changed)
    each = [rigs[factor].select(np.array([k])) for k, factor in enumerate(factors)]
    return join(tuple(small.numbered(one, k + 1) for k, one in enumerate(each)))


def stepped(name: str, before: int = BEFORE) -> Breaths:
    """Breaths of a rig that changes after the seventh, or another one."""
    factors, change = STEPS[name]
    late = np.arange(small.BREATHS) >= before
    for base, factor in factors.items():
        return changing(np.where(late, factor, 1.0), base)
    usual = small.made()
    return dataclasses.replace(usual, pressure=usual.pressure + change * late[:, None])


def late_by_a_sample(breaths: Breaths) -> Breaths:
    """The breaths with pressures of the sample before."""
    pressure = np.concatenate([breaths.pressure[:, :1], breaths.pressure[:, :-1]], axis=1)
    return dataclasses.replace(breaths, pressure=pressure)


def selected(breaths: Breaths) -> FittedModel:
    return small.concluded(breaths).named


def by_oracle(m: dict[str, dict[str, float]], noise: float = 0.1) -> Breaths:
    """Recording of the oracle; 64 samples a breath."""
    return cases.recording(small.BREATHS, m, R=20.0, C=20.0, noise=noise)


def test_a_change_beside_a_breath_that_nobody_saw_may_have_come_before_it():
    ids, position = np.array([3, 4, 6, 7]), np.array([0.0, 0.25, 0.75, 1.0])
    assert first_after(Interval(0.5, 0.5, 0.5), position, ids) == (6, 5, 6)
    assert first_after(Interval(0.9, 0.5, 0.95), position, ids) == (7, 5, 7)
    assert first_after(Interval(0.1, -0.1, 1.1), position, ids) == (4, 3, 7)


@pytest.mark.parametrize("name", STEPS)
def test_an_unguided_fit_finds_the_place_of_a_step(name):
    evaluator = small.split(stepped(name))
    base = fit_with_noise(evaluator, Hypothesis())
    fitted = evaluator.fit(Hypothesis((name,)), base.noise, base)
    place = fitted.column(f"{name}.at")[0] * (small.BREATHS - 1)
    assert BEFORE - 1 <= place <= BEFORE + 1
    change = STEPS[name][1]
    assert fitted.column(f"{name}.change")[0] == pytest.approx(change, rel=0.1, abs=0.02)


@pytest.mark.parametrize(("before", "gain_sd"), [(BEFORE, 0.0), (BEFORE + 1, 0.1)])
def test_the_first_breath_after_a_change_is_found_where_no_fit_has_it(before, gain_sd):
    """The eighth breath trains nothing; that gains scatter makes up for no wrong place."""
    breaths = stepped("gain_step", before)
    evaluator = dataclasses.replace(small.split(breaths), gain_sd=gain_sd)
    noise = Noise((0.2,), (0.0,))
    fitted = evaluator.fit(Hypothesis(("gain_step",)), noise, start={"gain_step.at": 0.5})
    at = place_of_change(evaluator, fitted, make_data(breaths), "gain_step.at")
    assert before - 1 < at.value * (small.BREATHS - 1) < before
    assert at.low <= at.value <= at.high


def test_two_simulations_give_the_cost_of_every_place():
    evaluator = small.split(stepped("zero_step"))
    fitted = evaluator.fit(Hypothesis(("zero_step",)), Noise((0.2,), (0.0,)), iterations=2)
    problem, x = fitted.problem, fitted.minimum.x.copy()
    places, costs = problem.change_costs(x, "zero_step.at")
    assert len(places) == len(problem.data) - 3
    for place, cost in zip(places, costs, strict=True):
        x[problem.unknowns.of("zero_step.at")] = place
        assert cost == pytest.approx(problem.cost(x), rel=1e-9)
    best = problem.at_likeliest_changes(x, 0.0)
    assert best is not None
    assert problem.cost(best) == pytest.approx(costs.min(), rel=1e-9)


def test_a_step_is_no_drift_and_no_scatter():
    """Pattern 1 and 4."""
    found = selected(stepped("gain_step"))
    assert found.names == ("gain_step",)


def test_a_drift_of_the_gain_is_no_step_and_no_drift_of_the_lung():
    """Pattern 4: a blower that warms up became drifts of R and C."""
    x = np.linspace(0.0, 1.0, small.BREATHS)
    found = selected(changing(1.0 - 0.25 * x, "gain"))
    assert found.names == ("gain_drift",)
    assert found.column("gain_drift.change")[0] == pytest.approx(-0.25, abs=0.03)


@pytest.mark.slow
def test_pressure_that_is_late_by_a_sample_makes_no_late_valves():
    """Pattern 3."""
    recorded = small.made()
    found = selected(late_by_a_sample(recorded))
    assert found.names == ("clock_offset",)
    # An edge of a held command that comes late by one sample to two is first seen at one reading.
    interval = float(np.median(recorded.dt))
    assert 0.98 * interval <= found.column("clock_offset.offset")[0] <= 2.0 * interval


def test_clocks_that_run_apart_make_no_lags():
    """Pattern 3."""
    found = selected(by_oracle({"clock_skew": {"skew": 0.01}}))
    assert found.names == ("clock_skew",)
    assert found.column("clock_skew.skew")[0] == pytest.approx(0.01, abs=0.002)


def test_trapped_gas_is_no_leak():
    """Pattern 6."""
    found = selected(by_oracle({"trapped_gas": {"pressure": 2.5}}))
    assert found.names == ("trapped_gas",)
    assert found.column("trapped_gas.pressure")[0] == pytest.approx(2.5, rel=0.1)


def test_the_verdict_says_what_changes_by_how_much_from_which_breath_on():
    """Pattern 5: breaths that are affected are told."""
    found = diagnose(stepped("gain_step"), settings=small.SETTINGS)
    assert found.verdict == "named"
    assert [missing.name for missing in found.mechanisms] == ["gain_step"]
    first = str(found).splitlines()[0]
    assert "the valve's gain rises by 2" in first
    assert f"from breath {found.traces.breaths.breath_id[BEFORE]} on" in first
    assert found.changes == ()
    assert found.open_loop.scatter_error == 0.0, "it is no scatter"
    assert found.open_loop.after.rmse < 0.25 * found.open_loop.refit.rmse
