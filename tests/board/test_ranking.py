"""Scores, intervals and ranks against independent implementations."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from scipy import stats

from ventbench.board import ranking
from ventbench.board.ranking import Entry, Event
from ventbench.board.record import Record
from ventbench.metrics import bootstrap

from .conftest import opened


@pytest.fixture(scope="module")
def base(drafts) -> Record:
    return opened(drafts["pid_best"])


def _entry(base: Record, name: str, by_draw: np.ndarray) -> Entry:
    """An entry whose score on each draw is given."""
    manifest = msgspec.structs.replace(base.manifest, name=name)
    submission = msgspec.structs.replace(base.header.submission, manifest=manifest)
    header = msgspec.structs.replace(base.header, submission=submission)
    drawn = np.broadcast_to(by_draw[:, None, None], base.drawn.shape).copy()
    # A fresh object: the cached properties of the old one do not come along.
    fields = {f.name: getattr(base, f.name) for f in dataclasses.fields(base)}
    record = Record(**{**fields, "header": header, "drawn": drawn})
    return Entry(record, (Event(record, None, True),), ())


def test_score_is_the_mean_over_draws_lungs_and_pips(base: Record) -> None:
    (row,) = ranking.rank([Entry(base, (), ())], "performance")
    assert row.score is not None
    assert row.score.value == pytest.approx(base.drawn.mean(), abs=1e-12)
    i, j = np.unravel_index(np.argmax(base.drawn.mean(axis=0)), (6, 6))
    assert row.worst[1:] == (base.lungs[i], base.pips[j])
    assert row.to_baseline is None
    assert row.to_above is None


def test_intervals_agree_with_scipy(base: Record) -> None:
    random = np.random.default_rng(3)
    common = random.normal(1.0, 0.3, 20)
    own, pid = common + random.normal(0.0, 0.05, 20), common + 0.1
    rows = ranking.rank([_entry(base, "own", own), _entry(base, "pid_best", pid)], "performance")
    row = next(row for row in rows if row.record.name == "own")
    assert row.score is not None
    assert row.to_baseline is not None

    def reference(values: np.ndarray) -> tuple[float, float]:
        found = stats.bootstrap(
            (values,), np.mean, n_resamples=40_000, method="percentile", rng=random
        )
        return found.confidence_interval

    # Both are random: 2000 resamples have a quantile's error of a few per cent of a deviation.
    for found, values in ((row.score, own), (row.to_baseline, own - pid)):
        sd = values.std() / np.sqrt(20)
        assert found.value == pytest.approx(values.mean(), abs=1e-12)
        assert (found.low, found.high) == pytest.approx(tuple(reference(values)), abs=0.12 * sd)
    # Pairing: what the draws have in common cancels.
    assert row.to_baseline.high - row.to_baseline.low < 0.3 * (row.score.high - row.score.low)


def test_rank_intervals_against_a_plain_count(base: Record) -> None:
    random = np.random.default_rng(5)
    common = random.normal(1.0, 0.2, 20)
    entries = [
        _entry(base, f"e{n}", common + 0.02 * n + random.normal(0, 0.06, 20)) for n in range(6)
    ]
    rows = ranking.rank(entries, "robustness")
    values = np.array([row.record.by_draw for row in rows])
    means = np.array([bootstrap.resampled_means(v) for v in values])
    for i, row in enumerate(rows):
        ranks = sorted(1 + sum(means[k, n] < means[i, n] for k in range(6)) for n in range(2000))
        assert row.ranks == (ranks[49], ranks[1950])
    assert [row.rank for row in rows] == [1, 2, 3, 4, 5, 6]
    assert any(row.ranks and row.ranks[0] < row.ranks[1] for row in rows)


def test_ties_share_a_rank_and_are_sorted_by_name(base: Record) -> None:
    same = np.linspace(0.9, 1.1, 20)
    worse = same + 0.5
    entries = [
        _entry(base, "last", worse),
        _entry(base, "zeta", same),
        _entry(base, "alpha", same + 1e-13),  # less than any machine decides
    ]
    rows = ranking.rank(entries, "robustness")
    assert [(row.record.name, row.rank) for row in rows] == [("alpha", 1), ("zeta", 1), ("last", 3)]
    assert [row.ranks for row in rows] == [(1, 1), (1, 1), (3, 3)]
    assert rows[1].to_above is not None
    assert not rows[1].to_above.clear
    assert rows[2].to_above is not None
    assert rows[2].to_above.clear
    assert rows[2].to_above.value == pytest.approx(0.5)


def test_order_of_arrival_does_not_matter(base: Record) -> None:
    random = np.random.default_rng(11)
    entries = [_entry(base, f"e{n}", random.normal(1, 0.1, 20)) for n in range(8)]
    first = ranking.rank(entries, "performance")
    assert ranking.rank(entries[::-1], "performance") == first


def test_nothing_to_rank() -> None:
    assert ranking.rank([], "performance") == []
