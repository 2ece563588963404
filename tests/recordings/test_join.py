"""Several recordings as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ventbench.errors import InputError
from ventbench.recordings import join

ARRAYS = (
    "breath_id", "R", "C", "time", "dt", "u_in", "u_out", "pressure", "valid", "time_inferred",
)  # fmt: skip


def test_all_breaths_in_order_without_a_source(make):
    one = replace(make(3, optional=True), source="a.csv", sha256="aa", notes=("first",))
    two = replace(make(2, seed=1), source="b.csv", notes=("second", "third"))
    both = join([one, two])
    assert len(both) == 5
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(both.select([0, 1, 2]), name), getattr(one, name))
        np.testing.assert_array_equal(getattr(both.select([3, 4]), name), getattr(two, name))
        assert not getattr(both, name).flags.writeable
    assert both.lung_ids.tolist() == [*one.lung_ids, *two.lung_ids]
    assert (both.source, both.sha256, both.flow, both.volume) == (None, None, None, None)
    assert both.notes == ("first", "second", "third")


def test_one_alone_and_the_parts_stay_as_they_are(make):
    one = replace(make(3, optional=True), source="a.csv")
    alone = join([one])
    np.testing.assert_array_equal(alone.pressure, one.pressure)
    assert one.flow is not None
    assert one.source == "a.csv"


def test_nothing_and_unequal_lengths_are_refused(make):
    with pytest.raises(InputError, match="no recordings to join"):
        join([])
    with pytest.raises(InputError, match=r"breaths of \[6, 8\] samples.*cut them to 6 samples"):
        join([make(2), make(2, samples=6)])
