"""The leaderboard of this repository is what its records give."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path

import pytest

from ventbench.base.errors import InputError
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
            (problem,) = set(report.problems)
            assert problem.startswith("simulators: ")
            assert name == frozen.MANIFEST or name in problem
            flip(copy / name, place)


@pytest.mark.parametrize("page", ["README.md", "docs/stress.md"])
def test_tables_of_the_docs_are_those_of_the_records(page: str) -> None:
    root = FOLDER.parent
    if page == "docs/stress.md":
        tool = runpy.run_path(str(root / "benchmarks" / "stress.py"))
        scores = [{"name": name, **own.headline()} for name, own in tool["recorded"]().items()]
        table = tool["table"](scores)
    else:
        tool = runpy.run_path(str(root / "benchmarks" / "board_tables.py"))
        table = tool["markdown"]()
    assert table in (root / page).read_text("utf-8"), "run the benchmark with --write"
