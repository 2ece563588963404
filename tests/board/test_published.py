"""The leaderboard of this repository is what its records give."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.board import comparison, ranking, store
from ventbench.board.verify import verify
from ventbench.plants import frozen

from .test_verify import flip

FOLDER = Path(__file__).parents[2] / "leaderboard"

#: Stands for the problem that a test makes itself, where a replay would only take time.
NOT_MEANT = "left out"

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="this copy of the project has no leaderboard"
)


@pytest.fixture(autouse=True)
def _published() -> None:
    """The reference errors stay the published ones, as the records are."""


def nothing() -> frozen.Frozen:
    """No simulators, so that nothing is replayed."""
    raise InputError(NOT_MEANT)


def test_hashes_and_attestations_are_in_order() -> None:
    report = verify(FOLDER, nothing)
    assert report.problems == [f"simulators: {NOT_MEANT}"] * len(report.problems)
    assert report.records > report.replayed == 0


@pytest.mark.slow
@pytest.mark.xfail(
    strict=True, reason="the round was scored before the safety gate counted all time above"
)
def test_the_published_leaderboard_verifies() -> None:
    report = verify(FOLDER, frozen.load)
    assert report.problems == []
    assert report.replayed > 0
    assert report.notes == []
    assert report.deviation <= 1e-9


@pytest.mark.slow
def test_no_byte_of_the_simulators_may_change(tmp_path: Path) -> None:
    copy = shutil.copytree(frozen.folder(), tmp_path / "simulators")

    def load() -> frozen.Frozen:
        return frozen.load(path=copy)

    for name in (frozen.MANIFEST, frozen.MEMBERS, frozen.SEEN):
        size = (copy / name).stat().st_size
        for place in (0, size // 5, size // 3, size // 2, size - 1):
            flip(copy / name, place)
            report = verify(FOLDER, load)
            assert report.replayed == 0
            said = {x for x in report.problems if x.startswith("simulators: ")}  # and of rounds
            (problem,) = said
            assert name == frozen.MANIFEST or name in problem
            flip(copy / name, place)


def test_tables_of_the_docs_are_those_of_the_records() -> None:
    root = FOLDER.parent
    tables = runpy.run_path(str(root / "benchmarks" / "board_tables.py"))["tables"]()
    for page, (_, table) in tables.items():
        assert table in (root / page).read_text("utf-8"), f"{page}: board_tables.py --write"


def test_only_unseen_draws_of_a_round_count() -> None:
    board = ranking.board(store.load(FOLDER))
    tracks = [track for track in board if track.round is not None and track.ranked]
    assert len(tracks) >= 2
    for track in tracks:
        rigs, names = track.ranked[0].record.headroom, [row.record.name for row in track.ranked]
        seen = np.flatnonzero(~rigs.ranked)
        assert 0 < len(seen) < rigs.ranked.size
        again = comparison.ranks(
            np.stack(
                [
                    np.delete(r.record.headroom.normalised[1:], seen, 0).mean(axis=2).T
                    for r in track.ranked
                ]
            ),
            np.delete(rigs.session, seen, 1),
            [names.index(r.entry.source) if r.entry.source else None for r in track.ranked],
            matters=comparison.POINTS,
        )
        assert again.rank.tolist() == [row.rank for row in track.ranked]
        for row in track.ranked:
            assert row.error is not None
            unseen = np.delete(row.record.drawn, seen, 0)
            assert row.error.value == pytest.approx(unseen.mean(), abs=1e-12)
            assert row.error.low < row.error.value < row.error.high
            means = np.delete(row.record.headroom.normalised[1:], seen, 0)
            assert row.normalised is not None
            assert row.normalised.score.value == pytest.approx(means.mean(), abs=1e-9)


def test_clusters_of_stress_are_the_rigs_that_ran(monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[np.ndarray] = []
    ranks = comparison.ranks

    def spied(values: np.ndarray, rig: np.ndarray, *others: Any, **options: Any) -> Any:
        used.append(rig)
        return ranks(values, rig, *others, **options)

    monkeypatch.setattr(comparison, "ranks", spied)
    leaderboard = store.load(FOLDER)
    track = next(x for x in ranking.board(leaderboard) if x.stress)
    tables = track.stress[0].tables
    rigs = track.stress[0].row.record.headroom
    np.testing.assert_array_equal(
        tables.rig, rigs.session[:, rigs.ranked][:, : tables.rig.shape[1]]
    )
    assert sum(np.array_equal(rig, tables.rig) for rig in used) == 1
