"""The leaderboard of this repository is what its records give."""

from __future__ import annotations

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.board import comparison, ranking, replay, schema
from ventbench.board.verify import verify
from ventbench.entries.runs import DRAWS, pip_columns
from ventbench.plants import frozen
from ventbench.task import draws

from . import numpy_replay
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

    for name in (frozen.MANIFEST, frozen.MEMBERS, frozen.TRAINING_LIST):
        size = (copy / name).stat().st_size
        for place in (0, size // 5, size // 3, size // 2, size - 1):
            flip(copy / name, place)
            report = verify(FOLDER, load)
            assert report.replayed == 0
            said = [x for x in report.problems if "simulators: " in x]  # of a record, or of all
            assert said
            assert name == frozen.MANIFEST or all(name in problem for problem in said)
            flip(copy / name, place)


def test_tables_of_the_docs_are_those_of_the_records() -> None:
    root = FOLDER.parent
    tables = runpy.run_path(str(root / "benchmarks" / "board_tables.py"))["tables"]()
    for page, (_, table) in tables.items():
        assert table in (root / page).read_text("utf-8"), f"{page}: board_tables.py --write"


def test_only_unseen_draws_of_a_round_count() -> None:
    board = ranking.board(replay.load(FOLDER))
    tracks = [track for track in board if track.round is not None and track.listed]
    assert len(tracks) >= 2
    for track in tracks:
        rigs, names = track.listed[0].record.figures, [row.record.name for row in track.listed]
        seen = np.flatnonzero(~rigs.ranked)
        assert 0 < len(seen) < rigs.ranked.size
        again = comparison.ranks(
            np.stack(
                [
                    np.delete(r.record.figures.normalised[1:], seen, 0).mean(axis=2).T
                    for r in track.listed
                ]
            ),
            np.delete(rigs.rig, seen, 1),
            [names.index(r.source) if r.source else None for r in track.listed],
            matters=comparison.POINTS,
        )
        assert again.rank.tolist() == [row.place and row.place.rank for row in track.listed]
        for row in track.listed:
            assert row.error is not None
            unseen = np.delete(row.record.figures.drawn, seen, 0)
            assert row.error.value == pytest.approx(unseen.mean(), abs=1e-12)
            assert row.error.low < row.error.value < row.error.high
            means = np.delete(row.record.figures.normalised[1:], seen, 0)
            assert row.normalised is not None
            assert row.normalised.value == pytest.approx(means.mean(), abs=1e-9)


def flat(values: dict[str, np.ndarray], at: tuple) -> dict[str, np.ndarray]:
    """Some cells, on one axis."""
    return {name: value[at] for name, value in values.items()}


@pytest.mark.slow
def test_numpy_alone_gives_the_errors_again() -> None:
    """Of one record on all cells, and of one under stress, by code that shares nothing."""
    board = replay.load(FOLDER)
    plain = next(x for x in board.scores if x.track == "performance")
    stressed = next(x for x in board.scores if x.figures.stressed is not None)
    own = FOLDER / "rounds" / plain.header.draws.season
    rigs, cells = numpy_replay.cells_of(frozen.folder(), own)

    def errors(about: schema.Commands, *at: np.ndarray, condition: int | None = None) -> np.ndarray:
        """At lungs, draws and PIPs; the commands of a condition, or without one those of a cell."""
        described = {"sha256": about.sha256, "shape": about.shape}
        commands = numpy_replay.commands_of(FOLDER / "records", described)
        lung, draw, pip = (x.ravel() for x in np.broadcast_arrays(*at))
        if condition is None:
            asked = commands[lung, draw, pip]
        else:
            asked = commands[condition].reshape(len(lung), *commands.shape[3:])
        found = numpy_replay.errors(flat(rigs, (lung, draw)), flat(cells, (lung, draw, pip)), asked)
        return found.reshape(np.broadcast_shapes(*map(np.shape, at)))

    every = np.ix_(range(6), range(1 + draws.COUNT), range(6))
    found = np.moveaxis(errors(plain.header.commands, *every), 1, 0)
    np.testing.assert_allclose(found, plain.figures.error, rtol=0, atol=1e-9)
    stress, runs = stressed.header.stress, stressed.figures.stressed
    assert stress is not None
    assert runs is not None
    ranked = 1 + np.flatnonzero(stressed.figures.ranked)[:DRAWS]
    at = np.arange(6)[:, None], ranked, pip_columns(6, DRAWS)
    # What sits at the sensor changes commands, and no pressure but by them.
    some = [
        k
        for k, one in enumerate(runs.conditions)
        if all(name.startswith("sensor_") for name in one.stressors)
    ]
    assert len(some) == 7
    for k in some:
        found = errors(stress.commands, *at, condition=k)
        np.testing.assert_allclose(found, runs.error[k], rtol=0, atol=1e-9)
