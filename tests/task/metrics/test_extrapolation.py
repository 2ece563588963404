"""How much of what is commanded lies beyond the recordings."""

from __future__ import annotations

import numpy as np
import pytest

from ventbench.task.metrics.open_loop import (
    EDGES,
    SPARSE_BELOW,
    by_lung,
    command_counts,
    extrapolation,
)


def test_commands_are_counted_in_ranges_of_ten():
    counts = command_counts([[0.0, 9.99], [10.0, 100.0]])
    assert counts.tolist() == [2, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    assert len(EDGES) == len(counts) + 1


def test_shares_and_recorded_samples():
    recorded = np.full(10, SPARSE_BELOW)
    recorded[3], recorded[9] = SPARSE_BELOW - 1, 0
    share = extrapolation([5.0, 35.0, 70.0, 95.0], recorded)
    assert share.wide_open == 0.5
    assert share.sparse == 0.5  # 35 % and 95 %
    assert share.recorded_wide_open == 2 * SPARSE_BELOW
    assert share.recorded == 9 * SPARSE_BELOW - 1


def test_each_lung_is_compared_with_its_own_recordings():
    lungs = {
        "R5C10": {"recorded_commands": [0] * 10},
        "R20C50": {"recorded_commands": [100] * 10},
    }
    shares = by_lung({name: [50.0] for name in lungs}, lungs)
    assert (shares["R5C10"].sparse, shares["R20C50"].sparse) == (1.0, 0.0)
    with pytest.raises(KeyError):
        by_lung({"R5C20": [50.0]}, lungs)
