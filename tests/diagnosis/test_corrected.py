"""What becomes of a simulator: answers of the plant, and simulators that are left as they are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ventbench import precision
from ventbench.diagnosis import corrected as module
from ventbench.diagnosis.corrected import correct
from ventbench.diagnosis.identification import held_out
from ventbench.diagnosis.settings import DEFAULT
from ventbench.interfaces import Plant
from ventbench.lungs import lung
from ventbench.physics import physics
from ventbench.plants.catalog import load_simulators
from ventbench.recordings.breaths import Breaths

from . import small


@pytest.fixture(scope="module")
def breaths() -> Breaths:
    return small.made()


def plants(**base: float) -> dict[str, Plant]:
    with precision.float64():
        return {small.LABEL: physics(lung(small.LABEL), {}).having(**base)}


def something(pressure: np.ndarray, plant: dict[str, Plant]) -> Any:
    """What is asked of something found: pressures and plants."""
    return SimpleNamespace(
        conclusion=SimpleNamespace(full=None, base=None, noise=None),
        evaluator=SimpleNamespace(training=SimpleNamespace(data=None)),
        pressures=lambda fitted, held, first: pressure,
        plants=lambda: plant,
    )


@pytest.mark.parametrize("worse", [False, True], ids=["better", "worse"])
def test_a_simulator_that_would_err_more_is_left_as_it_is(breaths, monkeypatch, worse):
    given, own, other = plants(R=10.0), plants(R=20.0), plants(R=30.0)
    before = load_simulators(given).pressures(breaths)
    # The found physics is the simulator's own plus the whole error, or minus it.
    error = breaths.pressure - before
    after = before - error if worse else before + 0.9 * error
    monkeypatch.setattr(module, "refit_base_parameters", lambda *_: None)
    held = held_out(breaths)
    found, had = something(after, other), something(before, own)
    one = correct(breaths, held, before, found, had, load_simulators(given))
    assert one.unchanged is worse
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


@pytest.mark.parametrize(
    ("full", "named", "kept"),
    [(0.1, 0.2, "full"), (0.6, 0.2, "named"), (0.6, 0.7, "base")],
)
def test_of_the_base_model_is_kept_what_does_not_throw_breaths_far_off(
    breaths, monkeypatch, full, named, kept
):
    before = load_simulators(plants(R=10.0)).pressures(breaths)
    error = breaths.pressure - before
    gains = {"base": 0.5, "full": 1.0 - full, "named": 1.0 - named}

    def pressures(fitted: Any, held: Any, first: Any) -> np.ndarray:
        return before + gains[fitted.which] * error

    fitted = {key: SimpleNamespace(which=key, names=("leak",)) for key in gains}
    found: Any = SimpleNamespace(
        conclusion=SimpleNamespace(**fitted, unnamed=object()), pressures=pressures,
        evaluator=SimpleNamespace(settings=DEFAULT), fit=fitted["full"],
    )  # fmt: skip
    monkeypatch.setattr(module.estimates, "plants", lambda fit: fit.which)
    monkeypatch.setattr(module.estimates, "plants_of", lambda one, evaluator: one.which)
    one = correct(breaths, held_out(breaths), before, found, None, load_simulators("physics"))
    assert one.plants == kept
    np.testing.assert_allclose(one.pressures["after"], before + gains[kept] * error)
    assert bool(one.notes) is (kept != "full")
    assert not one.unchanged
    fitted["full"].names = ("patient_effort",)  # the mean of all breaths' is no breath's
    one = correct(breaths, held_out(breaths), before, found, None, load_simulators("physics"))
    assert (one.plants, one.notes) == ("full", ())


def test_a_few_breaths_far_off_are_enough(breaths, monkeypatch):
    """Though most are better than refitted, and the mean error with them."""
    before = load_simulators(plants(R=10.0)).pressures(breaths)
    error, held = breaths.pressure - before, held_out(breaths)
    left = np.full((len(breaths), 1), 0.1)
    left[np.flatnonzero(~held)[0]] = 2.5

    def pressures(fitted: Any, held: Any, first: Any) -> np.ndarray:
        return breaths.pressure - {"base": 0.5, "full": left, "named": 0.3}[fitted.which] * error

    fitted = {k: SimpleNamespace(which=k, names=("leak",)) for k in ("base", "full", "named")}
    found: Any = SimpleNamespace(
        conclusion=SimpleNamespace(**fitted, unnamed=object()), pressures=pressures,
        evaluator=SimpleNamespace(settings=DEFAULT), fit=fitted["full"],
    )  # fmt: skip
    fitted = ~held[:, None] & breaths.valid & (breaths.time > 0)
    means = [np.abs(x * error)[fitted].mean() for x in (left, 0.5)]
    assert means[0] < means[1]
    monkeypatch.setattr(module.estimates, "plants_of", lambda one, evaluator: one.which)
    one = correct(breaths, held, before, found, None, load_simulators("physics"))
    assert (one.plants, len(one.notes)) == ("named", 1)


def test_held_out_breaths_do_not_decide(breaths, monkeypatch):
    given = plants(R=10.0)
    before = load_simulators(given).pressures(breaths)
    held = held_out(breaths)
    error = breaths.pressure - before
    after = before + np.where(held[:, None], -9.0, 0.5) * error
    monkeypatch.setattr(module, "refit_base_parameters", lambda *_: None)
    one = correct(
        breaths,
        held,
        before,
        something(after, given),
        something(before, given),
        load_simulators(given),
    )
    assert not one.unchanged
    assert one.training_errors[1] == pytest.approx(0.5 * one.training_errors[0])


def test_a_function_has_corrected_pressures_but_no_plants(breaths, monkeypatch):
    def still(u_in, u_out, dt, *, R, C, initial_pressure):
        return np.full(len(u_in), initial_pressure)

    simulators = load_simulators(still)
    before = simulators.pressures(breaths)
    after = before + 0.9 * (breaths.pressure - before)
    monkeypatch.setattr(module, "refit_base_parameters", lambda *_: None)
    found, had = something(after, plants()), something(before, plants())
    correction = correct(breaths, held_out(breaths), before, found, had, simulators)
    assert correction.plants == {}
    np.testing.assert_allclose(correction.pressures["after"], after)
    assert "has no plant that could be corrected" in correction.notes[0]
