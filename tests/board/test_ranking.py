"""Scores, intervals and ranks against independent implementations."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from ventbench.board import ranking, rounds
from ventbench.board.ranking import Place, Row
from ventbench.board.record import Record
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS

from .conftest import ROUND, derived


@pytest.fixture(scope="module")
def base(drafts, simulators, entered, reference) -> Record:
    return derived(drafts["pid_best"], simulators, rounds.load(entered, ROUND))


def _entry(base: Record, name: str, by_draw: np.ndarray) -> Row:
    """An entry whose normalised score on each draw is given."""
    manifest = msgspec.structs.replace(base.manifest, name=name)
    submission = msgspec.structs.replace(base.header.submission, manifest=manifest)
    header = msgspec.structs.replace(base.header, submission=submission)
    own = base.figures
    error = own.controllable.copy()
    scale = np.maximum(own.pid - own.attainable, 0.1)[1:]
    error[1:] = own.attainable[1:] + by_draw[:, None, None] / 100.0 * scale
    figures = dataclasses.replace(own, controllable=error)
    record = dataclasses.replace(base, header=header, derived=figures)
    return Row(record, (record,), "ranked")


def test_score_is_the_mean_over_draws_lungs_and_pips(base: Record) -> None:
    (row,) = ranking.rank([Row(base, (), "ranked")])
    assert row.error is not None
    assert row.normalised is not None
    assert row.error.value == pytest.approx(base.figures.drawn.mean(), abs=1e-12)
    own = base.figures
    expected = 100 * (own.controllable - own.attainable) / np.maximum(own.pid - own.attainable, 0.1)
    assert row.normalised.value == pytest.approx(expected[1:].mean(), abs=1e-9)
    i, j = np.unravel_index(np.argmax(own.drawn.mean(axis=0)), (6, 6))
    assert row.worst[1:] == (LUNG_IDS[i], protocol.PIPS[j])
    assert row.to_baseline is None
    assert row.to_above is None


def test_differences_are_paired(base: Record) -> None:
    """What the draws have in common cancels."""
    random = np.random.default_rng(3)
    common = random.normal(100.0, 30.0, 20)
    own, pid = common + random.normal(0.0, 5.0, 20), common + 10.0
    rows = ranking.rank([_entry(base, "own", own), _entry(base, "pid_best", pid)])
    row = next(row for row in rows if row.record.name == "own")
    assert row.normalised is not None
    score, to_pid = row.normalised, row.to_baseline
    assert to_pid is not None
    assert score.value == pytest.approx(own.mean(), abs=1e-9)
    assert to_pid.value == pytest.approx((own - pid).mean(), abs=1e-9)
    assert to_pid.low < to_pid.value < to_pid.high
    assert to_pid.high - to_pid.low < 0.5 * (score.high - score.low)


def test_ties_share_a_rank_and_are_sorted_by_name(base: Record) -> None:
    same = np.linspace(90.0, 110.0, 20)
    entries = [
        _entry(base, "last", same + 50.0),
        _entry(base, "zeta", same),
        _entry(base, "alpha", same + 1e-13),  # less than any machine decides
    ]
    rows = ranking.rank(entries)
    assert [row.record.name for row in rows] == ["alpha", "zeta", "last"]
    assert [row.place for row in rows] == [Place(1, 1, 2), Place(1, 1, 2), Place(3, 3, 3)]
    above = [row.to_above for row in rows]
    assert above[1] is not None
    assert not above[1].clear
    assert above[2] is not None
    assert above[2].clear
    assert above[2].value == pytest.approx(50.0)


def test_order_of_arrival_does_not_matter(base: Record) -> None:
    random = np.random.default_rng(11)
    entries = [_entry(base, f"e{n}", random.normal(10 * n, 10, 20)) for n in range(8)]
    first = ranking.rank(entries)
    assert ranking.rank(entries[::-1]) == first


def test_nothing_to_rank() -> None:
    assert ranking.rank([]) == []
