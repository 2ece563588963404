"""What becomes of a simulator: it is never worse on the breaths that were set aside to judge it."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from proofs.challenge.first import rig
from ventbench.base import compilation
from ventbench.diagnosis import corrected as module
from ventbench.diagnosis.corrected import choose, compare_open_loop, correct, fit_open_loop
from ventbench.diagnosis.evaluator import make_evaluator
from ventbench.diagnosis.experiment import Judge, prepare, split
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.settings import DEFAULT
from ventbench.physics import paths, physics
from ventbench.plants.catalog import load_simulators
from ventbench.plants.plant_files import parse_rig_id
from ventbench.recordings.breaths import Breaths, join
from ventbench.system_id import Noise, make_data
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import lung

from . import made, small


@pytest.fixture(scope="module")
def breaths() -> Breaths:
    return small.made(breaths=24)


def plants(**base: float) -> dict[str, Plant]:
    with compilation.float64():
        return {small.LABEL: physics(lung(small.LABEL), {}).having(**base)}


def something(pressure: np.ndarray, plant: dict[str, Plant]) -> Any:
    """What is asked of an identified model: pressures and plants."""
    return SimpleNamespace(
        conclusion=SimpleNamespace(full=None, base=None, noise=Noise()),
        evaluator=SimpleNamespace(training=SimpleNamespace(data=None)),
        pressures=lambda fitted, data, first: pressure,
        plants=lambda: plant,
    )


@pytest.fixture
def fake(monkeypatch) -> None:
    """No fits: the refitted model is the simulator's own."""
    monkeypatch.setattr(module, "refit_base_parameters", lambda *_: None)
    monkeypatch.setattr(module, "_least_error_model", lambda *_: None)
    monkeypatch.setattr(module.estimates, "plants_of", lambda fitted, evaluator: plants(R=25.0))


@settings(max_examples=60)
@given(
    st.lists(st.floats(0.0, 3.0), min_size=2, max_size=2),
    st.lists(st.floats(0.0, 3.0), min_size=2, max_size=2),
    st.integers(0, 2**16),
)
def test_whatever_the_candidates_no_lung_gets_worse(refit, after, seed):
    """The guarantee, for errors of any size and of any breath."""
    one = made.breaths(n=24, samples=30)
    R = np.where(np.arange(24) % 2, 20.0, 5.0)
    both = dataclasses.replace(one, R=R)
    rng = np.random.default_rng(seed)
    sizes = {"before": (1.0, 1.0), "refit": refit, "after": after}
    pressures = {
        stage: both.pressure
        + np.where(R == 5.0, size[0], size[1])[:, None] * rng.standard_normal(both.pressure.shape)
        for stage, size in sizes.items()
    }
    judge = Judge(both, split(both).judging)
    stages = choose(both, judge, pressures)
    final = {"before": pressures["before"]} | {
        stage: module.by_lung(both, pressures, chosen)
        for stage, chosen in zip(("refit", "after"), stages, strict=True)
    }
    line = compare_open_loop(both, judge, final, 0.2)
    everything = {"before": line.before, "refit": line.refit, "after": line.after}
    for group in (everything, line.groups["lung R5C50"], line.groups["lung R20C50"]):
        for kind in ("rmse", "mae"):
            before, refitted, corrected = (getattr(group[key], kind) for key in everything)
            assert corrected <= refitted + 1e-12
            assert refitted <= before + 1e-12


def test_only_breaths_that_were_set_aside_choose(breaths):
    uses = split(breaths)
    assert not (uses.judging & uses.identifying).any()
    error = breaths.pressure - load_simulators("physics").pressures(breaths)
    before = breaths.pressure - error
    for where, wanted in ((uses.judging, "before"), (~uses.judging, "after")):
        after = before + np.where(where[:, None], -9.0, 0.5) * error
        pressures = {"before": before, "refit": before, "after": after}
        assert choose(breaths, Judge(breaths, uses.judging), pressures)[1][small.LABEL] == (
            "refit" if wanted == "before" else "after"
        )


@pytest.mark.parametrize("worse", [False, True], ids=["better", "worse"])
def test_a_simulator_that_would_err_more_is_left_as_it_is(breaths, fake, worse):
    given, own, other = plants(R=10.0), plants(R=20.0), plants(R=30.0)
    before = load_simulators(given).pressures(breaths)
    # The found physics is the simulator's own plus the whole error, or minus it.
    error = breaths.pressure - before
    after = before - error if worse else before + 0.9 * error
    found, had = something(after, other), something(before, own)
    one = correct(prepare(breaths, load_simulators(given)), found, had)
    assert one.unchanged is worse
    assert one.helps is not worse
    np.testing.assert_allclose(one.pressures["after"], before if worse else after)
    assert one.training_errors[1] == pytest.approx((2.0 if worse else 0.1) * one.training_errors[0])
    plant: Any = one.plants[small.LABEL]
    assert float(plant.simulator.get("R")) == 10.0
    assert float(plant.without_mechanisms.get("R")) == 20.0
    assert float(plant.with_mechanisms.get("R")) == (20.0 if worse else 30.0)
    if worse:  # the plant too
        np.testing.assert_allclose(
            load_simulators(one.plants).pressures(breaths), before, atol=1e-9
        )


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_any_simulator_is_corrected_for_the_least_error(breaths, fake, monkeypatch, share):
    given, own, other = plants(R=10.0), plants(R=20.0), plants(R=30.0)
    before = load_simulators(given).pressures(breaths)
    error = breaths.pressure - before
    reported, least = before + 0.8 * error, before + (1.0 - 0.2 * share) * error
    identified = something(reported, other)
    identified.evaluator.settings = DEFAULT
    identified.pressures = lambda fitted, data, first: least if fitted == "again" else reported
    monkeypatch.setattr(module, "_least_error_model", lambda *_: "again")
    experiment = prepare(breaths, load_simulators(given))
    correction = correct(experiment, identified, something(before, own))
    again = share < DEFAULT.correction.drift_ratio
    np.testing.assert_allclose(correction.pressures["after"], least if again else reported)
    plant: Any = correction.plants[small.LABEL]
    assert float(plant.with_mechanisms.get("R")) == (25.0 if again else 30.0)
    assert any("least open-loop error" in note for note in correction.notes) is again

    # A simulator that is left as it is has no note on a correction.
    reported, least = before - 2.0 * error, before - error
    correction = correct(experiment, identified, something(before, own))
    assert correction.unchanged
    assert correction.notes == ()


def test_a_correction_that_helps_its_own_breaths_alone_is_not_chosen(breaths, fake):
    given = plants(R=10.0)
    before = load_simulators(given).pressures(breaths)
    uses = split(breaths)
    error = breaths.pressure - before
    after = before + np.where(uses.judging[:, None], -9.0, 0.5) * error
    one = correct(
        prepare(breaths, load_simulators(given)), something(after, given), something(before, given)
    )
    assert not one.unchanged
    assert not one.helps
    assert one.training_errors[1] == pytest.approx(0.5 * one.training_errors[0])
    np.testing.assert_array_equal(one.pressures["after"], before)


def test_a_function_has_corrected_pressures_but_no_plants(breaths, fake):
    def still(u_in, u_out, dt, *, R, C, initial_pressure):
        return np.full(len(u_in), initial_pressure)

    simulators = load_simulators(still)
    before = simulators.pressures(breaths)
    after = before + 0.9 * (breaths.pressure - before)
    found, had = something(after, plants()), something(before, plants())
    correction = correct(prepare(breaths, simulators), found, had)
    assert correction.plants == {}
    np.testing.assert_allclose(correction.pressures["after"], after)
    assert f"no plant stands behind {simulators.name} that" in correction.notes[0]


@pytest.mark.parametrize("gains", [(22.8, 30.0), (22.8, 22.8)])
def test_each_ventilator_has_its_gain_if_that_helps(gains, monkeypatch):
    """Two ventilators, which their clocks tell apart, with one lung; and two that are alike."""
    parts = []
    for gain, interval in zip(gains, (0.0319, 0.0340), strict=True):
        monkeypatch.setattr(rig, "INTERVALS", (interval,))
        base = dataclasses.replace(small.RIG, gain=gain)
        parts.append(small.made(base=base, breaths=12, noise=0.1, seed=len(parts)))
        parts[-1] = dataclasses.replace(parts[-1], breath_id=np.arange(12) + 12 * len(parts))
    breaths = join(parts)
    experiment = prepare(breaths, load_simulators("physics"))
    data, fitted = experiment.data, experiment.uses.fitted
    evaluator = make_evaluator(data, ~fitted, paths(), settings=small.SETTINGS)
    model = evaluator.fit(Hypothesis(), Noise((0.1,)))
    found = module._gains_of_rigs(experiment, model, evaluator)
    if gains[0] == gains[1]:
        assert found is None
        return
    assert found is not None
    at = {parse_rig_id(key)[1]: factor for key, factor in found.factors.items()}
    fast, slow = sorted(interval for interval in at if interval is not None)
    assert (fast, slow) == pytest.approx((0.0319, 0.0340), rel=0.01)
    ratio = at[slow] / at[fast]
    assert ratio == pytest.approx(gains[1] / gains[0], rel=0.05)
    common = evaluator.predict(model, evaluator.partition(data))[:, 0]
    mask = breaths.inspiratory & (breaths.time > 0)
    before, after = (
        experiment.judge.error(pressure, mask).mae for pressure in (common, found.pressures)
    )
    assert after < 0.5 * before


@pytest.mark.parametrize("label", [(20.0, 20.0), (50.0, 10.0), (5.0, 50.0)])
def test_the_refit_never_errs_more_than_the_label_whatever_the_start(label):
    """A stiff lung, a wrong label, noise that a wrong model makes look slow."""
    one = small.made(seed=3, noise=0.3, coloured=0.8, correlation=0.9)
    R, C = (np.full(len(one), value) for value in label)
    data = make_data(dataclasses.replace(one, R=R, C=C))
    evaluator = make_evaluator(data, small.HELD, paths(), settings=small.SETTINGS)
    training = evaluator.training
    slow = evaluator.fit(Hypothesis(), Noise((3.0,), (0.95,)), iterations=1)
    fitted = fit_open_loop(evaluator, slow, training, DEFAULT.correction, label=True)

    def error(pressure: np.ndarray) -> float:
        return float(np.sqrt(np.mean((pressure - training.data.measured[:, 0]) ** 2)))

    at_label = load_simulators("physics").pressures(
        dataclasses.replace(one, R=R, C=C).select(np.flatnonzero(~small.HELD))
    )
    assert error(evaluator.predict(fitted, training)[:, 0]) <= error(at_label)
    assert float(fitted.column("R")[0]) == pytest.approx(small.RIG.R, rel=0.15)
    assert float(fitted.column("C")[0]) == pytest.approx(small.RIG.C, rel=0.15)
