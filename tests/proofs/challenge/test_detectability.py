from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base, Case, Effect
from proofs.challenge.detectability import LIMIT, log_likelihood_loss
from proofs.challenge.first.rig import record


def recorded(*effects):
    case = Case("", 5.0, 20.0, effects, Base(5.0, 20.0), noise=0.2, breaths=3, samples=40)
    return case, record(case, np.random.default_rng(0), steps=16)


def test_a_lung_of_other_values_is_no_effect():
    none = Effect("valve_delay", "mild", "library", {"delay": 0.0})
    assert log_likelihood_loss(*recorded(none), 0) < 0.01


def test_a_tiny_effect_is_below_the_limit_and_a_strong_one_above():
    tiny = Effect("inertance", "mild", "library", {"inertance": 0.002})
    strong = Effect("valve_delay", "strong", "library", {"delay": 0.08})
    assert log_likelihood_loss(*recorded(tiny), 0) < LIMIT
    assert log_likelihood_loss(*recorded(strong), 0) > LIMIT


def test_noise_hides_by_its_square():
    case, breaths = recorded(Effect("turbulent_resistance", "mild", "library", {"quadratic": 4.0}))
    quiet, loud = (
        log_likelihood_loss(replace(case, step=0.0, noise=noise), breaths, 0)
        for noise in (0.1, 0.3)
    )
    assert quiet == pytest.approx(9 * loud, rel=1e-6)
