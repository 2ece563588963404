"""The leaderboard of this repository is what its records give."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.board import comparison, ranking, replay
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
def _witnesses() -> None:
    """The reference errors stay the published ones, as the records are."""


@pytest.fixture(autouse=True)
def _textbook() -> None:
    """So do the simulators."""


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


@pytest.mark.parametrize("page", ["README.md", "docs/stress.md"])
def test_tables_of_the_docs_are_those_of_the_records(page: str) -> None:
    root = FOLDER.parent
    if page == "docs/stress.md":
        tool = runpy.run_path(str(root / "benchmarks" / "stress.py"))
        scores = [{"name": name, **own.headline()} for name, own in tool["recorded"]().items()]
        if not scores:
            pytest.skip("the stressed commands of the last round are not at hand")
        table = tool["table"](scores)
    else:
        tool = runpy.run_path(str(root / "benchmarks" / "board_tables.py"))
        table = tool["markdown"]()
    assert table in (root / page).read_text("utf-8"), "run the benchmark with --write"


def test_only_unseen_draws_of_a_round_count() -> None:
    board = ranking.board(replay.load(FOLDER))
    tracks = [track for track in board if track.round is not None and track.ranked]
    assert len(tracks) >= 2
    for track in tracks:
        rigs, names = track.ranked[0].record.figures, [row.record.name for row in track.ranked]
        seen = np.flatnonzero(~rigs.ranked)
        assert 0 < len(seen) < rigs.ranked.size
        again = comparison.ranks(
            np.stack(
                [
                    np.delete(r.record.figures.normalised[1:], seen, 0).mean(axis=2).T
                    for r in track.ranked
                ]
            ),
            np.delete(rigs.rig, seen, 1),
            [names.index(r.entry.source) if r.entry.source else None for r in track.ranked],
            matters=comparison.POINTS,
        )
        assert again.rank.tolist() == [row.rank for row in track.ranked]
        for row in track.ranked:
            assert row.error is not None
            unseen = np.delete(row.record.figures.drawn, seen, 0)
            assert row.error.value == pytest.approx(unseen.mean(), abs=1e-12)
            assert row.error.low < row.error.value < row.error.high
            means = np.delete(row.record.figures.normalised[1:], seen, 0)
            assert row.normalised is not None
            assert row.normalised.score.value == pytest.approx(means.mean(), abs=1e-9)
