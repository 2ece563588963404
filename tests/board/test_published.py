"""The leaderboard of this repository is what its records give."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ventbench.board import store
from ventbench.board.verify import verify
from ventbench.plants import frozen

from .test_verify import flip

FOLDER = Path(__file__).parents[2] / "leaderboard"

pytestmark = pytest.mark.skipif(
    not (FOLDER / store.CHAIN).is_file(), reason="this copy of the project has no leaderboard"
)


def test_the_published_leaderboard_verifies() -> None:
    report = verify(FOLDER, frozen.load)
    assert report.problems == []
    assert report.replayed > 0
    assert report.notes == []
    assert report.deviation <= 1e-9


def test_no_byte_of_the_simulators_may_change(tmp_path: Path) -> None:
    copy = shutil.copytree(frozen.folder(1), tmp_path / "simulators")
    for name in (frozen.MANIFEST, frozen.MEMBERS, frozen.SEEN):
        size = (copy / name).stat().st_size
        for place in (0, size // 5, size // 3, size // 2, size - 1):
            flip(copy / name, place)
            report = verify(FOLDER, lambda version: frozen.load(version, copy))
            (problem,) = report.problems
            assert report.replayed == 0
            assert problem.startswith("simulators: ")
            assert name == frozen.MANIFEST or name in problem
            flip(copy / name, place)
