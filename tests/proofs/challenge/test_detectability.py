from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base, Case, Effect
from proofs.challenge.detectability import LIMIT, log_likelihood_loss
from proofs.challenge.first.rig import record
from proofs.challenge.generators import GENERATORS
from ventbench.recordings.breaths import make_breaths


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


@pytest.mark.parametrize("world", list(GENERATORS))
def test_rigs_side_by_side_are_those_alone(world):
    """Also where a patient breathes, whose efforts are drawn for each breath."""
    rng, at = np.random.default_rng(1), GENERATORS[world]
    (question,) = at.draw("null", 1, rng)
    effort = Effect("patient_effort", "strong", "half sine", {"amplitude": 5.0, "duration": 0.8})
    effects = () if world == "faults" else (effort,)
    base = Base(20.0, 30.0)
    one = replace(question.case, effects=effects, base=base)
    other = replace(one, base=Base(24.0, 27.0, 6.0, 5.5))
    time = np.tile(np.arange(12) * 0.03, (2, 1))
    columns = np.full((2, 12), 25.0), (time > 0.2).astype(np.int8), time
    breaths = make_breaths([2, 5], [20, 20], [30, 30], time, *columns)
    both = {
        key: np.repeat([getattr(each.base, key) for each in (one, other)], 2)
        for key in ("R", "C", "R_ex", "peep")
    }
    many = breaths.select([0, 1, 0, 1])
    start = np.array([5.0, 5.5])
    found = at.replay(
        replace(one, base=replace(base, **both)), many, np.concatenate([start, start]), 3
    )
    alone = [at.replay(case, breaths, start, 3) for case in (one, other)]
    np.testing.assert_allclose(found, np.concatenate(alone), atol=1e-9)
