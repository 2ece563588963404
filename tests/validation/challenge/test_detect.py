from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ventbench.validation.challenge.cases import Base, Case, Effect
from ventbench.validation.challenge.detect import LIMIT, nats
from ventbench.validation.challenge.rig import record


def recorded(*effects):
    one = Case("", 5.0, 20.0, effects, Base(5.0, 20.0), noise=0.2, breaths=3, samples=40)
    return one, record(one, np.random.default_rng(0), steps=16)


def test_nothing_is_worth_nothing():
    # A lung of other R and C is no effect: refitted, nothing remains.
    none = Effect("valve_delay", "mild", "library", {"delay": 0.0})
    assert nats(*recorded(none), 0) < 0.01


def test_a_tiny_effect_is_below_the_limit_and_a_strong_one_above():
    tiny = Effect("inertance", "mild", "library", {"inertance": 0.002})
    strong = Effect("valve_delay", "strong", "library", {"delay": 0.08})
    assert nats(*recorded(tiny), 0) < LIMIT < nats(*recorded(strong), 0)


def test_noise_hides_by_its_square():
    item = Effect("turbulent_resistance", "mild", "library", {"quadratic": 4.0})
    one, breaths = recorded(item)
    one = replace(one, step=0.0)
    quiet = nats(replace(one, noise=0.1), breaths, 0)
    assert quiet == pytest.approx(9 * nats(replace(one, noise=0.3), breaths, 0), rel=1e-6)
