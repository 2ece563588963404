from __future__ import annotations

import numpy as np
import pytest

from tests.validation.challenge.truths import drawn
from ventbench.errors import InputError
from ventbench.validation.challenge import make, seal
from ventbench.validation.challenge.cases import Base, Case, Effect
from ventbench.validation.challenge.plan import Drawn
from ventbench.validation.challenge.rig import record

EFFECTS = (
    Effect("nonlinear_compliance", "strong", "library", {"stiffening": 0.1}),
    Effect("sensor_lag", "strong", "library", {"tau": 0.1}),
)
# So stiff, and read so late, that the usual breaths end far above what a sensor reads.
STIFF = Drawn("pair", Case("case_0001", 5.0, 10.0, EFFECTS, Base(5.0, 10.0), breaths=12))


def usual(item, attempt):
    more = (f"again {attempt}",) if attempt else ()
    return record(item.case, seal.generator("s", "recording", item.case.name, *more))


def test_a_lung_that_leaves_the_range_with_all_usual_commands_is_recorded_gently(monkeypatch):
    monkeypatch.setattr(make, "_ATTEMPTS", 2)
    assert all(usual(STIFF, k).pressure.max() > make.PRESSURE.high for k in (0, 1))
    breaths = make._recorded("s", STIFF)
    assert make.PRESSURE.low <= breaths.pressure.min()
    assert 15.0 < breaths.pressure.max() <= make.PRESSURE.high


def test_what_stays_within_the_range_is_recorded_with_the_usual_commands():
    item = drawn("null")
    np.testing.assert_array_equal(make._recorded("s", item).u_in, usual(item, 0).u_in)


def test_a_case_that_no_commands_keep_in_range_asks_for_another_seed(monkeypatch):
    monkeypatch.setattr(make, "_ATTEMPTS", 1)
    monkeypatch.setattr(make, "_MORE", 0)
    with pytest.raises(InputError, match="another seed"):
        make._recorded("s", STIFF)
