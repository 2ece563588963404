"""The search by evidence: what labels say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ventbench.diagnosis import evidence
from ventbench.diagnosis.evidence import WARMTH, Scored, weigh
from ventbench.diagnosis.linearised import Term


def scored(*names: str, nats: float, label: float) -> Scored:
    """A set as if it was fitted."""
    fitted: Any = None
    noise: Any = None
    terms = tuple(Term(name, (1.0,)) for name in names)
    return Scored(fitted, terms, noise, 0.01, nats, label)


def test_labels_count_whole_where_the_likelihood_is_tempered():
    alone = scored(nats=10.0, label=-3.0)
    beside = scored("circuit_compliance", nats=10.0, label=0.0)
    names = frozenset({"circuit_compliance"})
    weights = weigh([alone, beside], [(0.0, ())])
    odds = np.log(weights[names] / weights[frozenset()])
    assert odds == pytest.approx(3.0 + evidence.prior(names))
    weights = weigh([alone, beside._replace(evidence=15.0)], [(0.0, ())])
    assert np.log(weights[names] / weights[frozenset()]) == pytest.approx(odds + 5.0 * WARMTH)
