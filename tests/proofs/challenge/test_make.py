from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base, Case, Effect, random_generator
from proofs.challenge.first.rig import record as record_finely
from proofs.challenge.make import PRESSURE, record_within_limits
from proofs.challenge.questions import DrawnCase
from tests.proofs.challenge.truths import drawn
from ventbench.base.errors import InputError

# The steps need not be fine here.
record = partial(record_finely, steps=8)

EFFECTS = (
    Effect("nonlinear_compliance", "strong", "library", {"stiffening": 0.1}),
    Effect("sensor_lag", "strong", "library", {"tau": 0.1}),
)
# So stiff, and read so late, that the usual breaths end far above what a sensor reads.
STIFF = DrawnCase("pair", Case("case_0001", 5.0, 10.0, EFFECTS, Base(5.0, 10.0), breaths=12))


def usual(question, attempt):
    repeated = (f"again {attempt}",) if attempt else ()
    rng = random_generator("s", "recording", question.case.name, *repeated)
    return record(question.case, rng)


def test_a_lung_that_leaves_the_limits_under_all_usual_commands_is_recorded_gently():
    assert all(usual(STIFF, k).pressure.max() > PRESSURE.high for k in (0, 1))
    breaths = record_within_limits("s", STIFF, usual=2, record=record)
    assert PRESSURE.low <= breaths.pressure.min()
    assert 15.0 < breaths.pressure.max() <= PRESSURE.high


def test_what_stays_within_the_limits_is_recorded_with_the_usual_commands():
    null = drawn("null")
    kept = record_within_limits("s", null, record=record)
    np.testing.assert_array_equal(kept.u_in, usual(null, 0).u_in)


def test_a_case_that_no_commands_keep_within_the_limits_asks_for_another_seed():
    with pytest.raises(InputError, match="another seed"):
        record_within_limits("s", STIFF, usual=1, gentle=0, record=record)


def test_each_attempt_has_other_commands():
    attempts = []

    def too_much_at_first(case, rng, *, share):
        breaths = record(case, rng, share=share)
        attempts.append(breaths)
        high = np.where(len(attempts) == 1, 200.0, breaths.pressure)
        return dataclasses.replace(breaths, pressure=high)

    kept = record_within_limits("s", drawn("null"), record=too_much_at_first)
    assert len(attempts) == 2
    assert np.any(attempts[0].u_in != attempts[1].u_in)
    np.testing.assert_array_equal(kept.u_in, attempts[1].u_in)
