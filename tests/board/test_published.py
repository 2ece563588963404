"""The leaderboard of this repository is what its records give."""

from __future__ import annotations

from pathlib import Path

import pytest

from ventbench.board import store
from ventbench.board.verify import verify
from ventbench.plants import frozen

FOLDER = Path(__file__).parents[2] / "leaderboard"


def test_the_published_leaderboard_verifies() -> None:
    if not (FOLDER / store.CHAIN).is_file():
        pytest.skip("this copy of the project has no leaderboard")
    report = verify(FOLDER, frozen.load)
    assert report.problems == []
    assert report.replayed > 0
    assert report.notes == []
