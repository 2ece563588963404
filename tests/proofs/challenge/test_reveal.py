from __future__ import annotations

import numpy as np
import pytest

from hardware_eval.emulation.cases import Base, Case, Effect
from proofs.challenge.first.rig import record
from proofs.challenge.reveal import oracle_rmse
from ventbench.base.errors import InputError

LEAK = Effect("leak", "strong", "library", {"conductance": 20.0})


def test_both_parts_are_needed():
    breaths = record(Case("", 5.0, 20.0, base=Base(5.0, 20.0), breaths=2), np.random.default_rng(0))
    with pytest.raises(InputError, match="are held out"):
        oracle_rmse(breaths, [1, 2], frozenset())


@pytest.mark.slow
def test_the_truth_leaves_noise_only():
    one = Case("", 5.0, 20.0, (LEAK,), Base(5.5, 19.0, gain=24.0), noise=0.1, breaths=20)
    breaths = record(one, np.random.default_rng(1))
    best = oracle_rmse(breaths, [3, 8, 13, 18], frozenset({"leak"}))
    blind = oracle_rmse(breaths, [3, 8, 13, 18], frozenset())
    assert 0.08 < best < 0.2  # the noise, and that of the first reading
    assert blind > 2 * best
