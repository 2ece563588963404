"""The board as pandas frames: the numbers of the records, in documented columns."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ventbench.base.errors import InputError
from ventbench.board import attestation, canonical, frames, replay
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS

from .conftest import KEY


def test_a_row_an_entry(full: Path, site: Path) -> None:
    board = frames.load_board(full)
    rows = list(csv.DictReader(io.StringIO((site / "leaderboard.csv").read_text())))
    assert list(board["name"]) == [row["name"] for row in rows]
    names = [name for column in frames.COLUMNS for name in column.names]
    assert list(board.columns[: len(names)]) == names
    for column in (
        "score_cmH2O",
        "normalised_to_pid_low",
        "normalised_to_above_high",
        "exploitation_cmH2O",
        "worst_pip",
    ):
        written = [float(row[column]) if row[column] else np.nan for row in rows]
        np.testing.assert_allclose(board[column], written, atol=1e-6)
    assert [("" if pd.isna(rank) else str(rank)) for rank in board["rank"]] == [
        row["rank"] for row in rows
    ]
    assert board["safe"].dtype == bool
    assert board["rank_low"].dtype == "Int64"


def test_scores_of_lungs_give_the_score(full: Path) -> None:
    board = frames.load_board(full, track="performance")
    assert set(board["track"]) == {"performance"}
    for kind in ("score", "nominal"):
        lungs = board[[f"{kind}_{lung}_cmH2O" for lung in LUNG_IDS]]
        np.testing.assert_allclose(lungs.mean(axis=1, skipna=False), board[f"{kind}_cmH2O"])


def test_seeds_stand_beside_the_entry_that_the_round_scored(leaderboard: Path) -> None:
    path = leaderboard / "rounds/r1/result.json"
    result = canonical.parse(path.read_bytes(), "result")
    key = "pid_best (performance)"
    before: Any = frames.load_board(leaderboard).set_index(["name", "track"])
    result["records"] = {key: before.loc[("pid_best", "performance"), "record"]}
    result["seeds"] = {key: [60.0, 62.0, 61.0, 63.0, 90.0]}
    path.write_bytes(canonical.canonical(result))
    attestation.sign(leaderboard, path, KEY)
    board: Any = frames.load_board(leaderboard)
    told = board[board["seeds"].notna()]
    assert told[["name", "track"]].values.tolist() == [["pid_best", "performance"]]
    low, middle, high = told[["seeds_low", "seeds", "seeds_high"]].to_numpy()[0]
    assert middle == 62.0  # the mean of the middle three
    assert 60.0 <= low < middle < high <= 90.0
    result["records"][key] = "0" * 64
    path.write_bytes(canonical.canonical(result))
    attestation.sign(leaderboard, path, KEY)
    board = frames.load_board(leaderboard)
    assert board["seeds"].isna().all()


def test_cells_are_those_of_the_records(full: Path) -> None:
    cells = frames.load_cells(full)
    record = replay.load(full).scores[0]
    figures = record.figures
    own = cells[cells["name"] == record.name].set_index(["draw", "lung", "pip"]).sort_index()
    assert len(own) == 21 * 6 * 6
    lung, pip = LUNG_IDS[2], protocol.PIPS[4]
    assert own.loc[(0, lung, pip), "error_cmH2O"] == figures.nominal[2, 4]
    assert own.loc[(7, lung, pip), "error_cmH2O"] == figures.drawn[6, 2, 4]
    assert own.loc[(7, lung, pip), "peak_cmH2O"] == figures.peak[7, 2, 4]
    assert own.loc[(7, lung, pip), "steps_above"] == figures.steps_above[7, 2, 4]
    board = frames.load_board(full).set_index("name")
    for name, score in board["score_cmH2O"].dropna().items():
        drawn = cells[(cells["name"] == name) & (cells["draw"] > 0)]
        np.testing.assert_allclose(np.mean(drawn["error_cmH2O"]), score)


def test_what_is_not_there_is_said(full: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no record"):
        frames.load_board(tmp_path)
    with pytest.raises(InputError, match="is not one of performance, robustness"):
        frames.load_cells(full, track="speed")
