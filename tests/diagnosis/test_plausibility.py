"""Which strengths are statements about a rig."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ventbench.diagnosis.settings import DEFAULT
from ventbench.diagnosis.validation import (
    excludes_neutral,
    explained_share,
    is_plausible,
)
from ventbench.mechanics.labels import Estimate
from ventbench.physics import library

SETTINGS = DEFAULT.plausibility


def fitted(strength: Any) -> Any:
    return SimpleNamespace(column=lambda path: np.atleast_1d(np.asarray(strength, float)))


def test_every_mechanism_has_a_least_strength_below_a_mild_one_and_a_reason():
    for name, mechanism in library().items():
        about = mechanism.description
        mild = abs(about.strength.mild - about.strength.neutral)
        assert 0.0 < about.least <= 0.5 * mild, name
        assert len(about.least_reason) > 15, name


@pytest.mark.parametrize(
    ("name", "strength", "plausible"),
    [
        ("exhalation_valve_delay", 0.003, False),
        ("exhalation_valve_delay", 0.03, True),
        ("sensor_lag", 0.010, False),
        ("sensor_lag", 0.05, True),
        ("valve_curve", -0.01, False),
        ("sensor_drift", -1.0, True),
        ("turbulent_resistance", (0.2, 4.0), True),  # of two lungs
        ("patient_effort", np.full(20, -0.18), False),
        ("patient_effort", np.tile([3.0, -3.0], 10), False),
        ("patient_effort", np.tile([-2.0, -4.0], 10), False),
        ("patient_effort", np.tile([3.0, 0.05], 10), True),
        ("patient_effort", np.tile([4.0, -0.7, -0.6], 7), True),  # other effects, not yet found
        ("patient_effort", [4.0] + [0.0] * 19, False),
    ],
)
def test_strengths(name, strength, plausible):
    assert is_plausible(fitted(strength), name, SETTINGS) is plausible


def test_an_interval_around_zero_names_nothing():
    assert not excludes_neutral(Estimate(0.3, "s", (0.0, 0.7)), "valve_delay")
    assert not excludes_neutral(Estimate(-0.2, "cmH2O", (-1.0, 0.5)), "sensor_drift")
    assert excludes_neutral(Estimate(-0.2, "cmH2O", (-0.3, -0.1)), "sensor_drift")


def test_a_shadow_of_an_effect_explains_the_square_of_their_correlation():
    effect, template = np.random.default_rng(4).standard_normal((2, 500))
    left = effect - template * (effect @ template) / (template @ template)
    before, after = (float(np.sqrt(np.mean(error**2))) for error in (effect, left))
    correlation = effect @ template / np.linalg.norm(effect) / np.linalg.norm(template)
    assert explained_share(before - after, after, after) == pytest.approx(correlation**2)
    assert explained_share(0.3, 0.2, 0.0) == explained_share(np.nan, 0.2, 0.5) == 1.0
