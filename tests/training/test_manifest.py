"""The manifest: which session stands for a lung, and what is written where nothing is known."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from ventbench.lungs import LUNG_IDS
from ventbench.plants import frozen
from ventbench.plants.learned import Architecture
from ventbench.plants.sessions import Session, Sessions
from ventbench.recordings import load, write
from ventbench.training import simulator
from ventbench.training.hybrid.fit import HybridConfig
from ventbench.training.learned import LearnedConfig
from ventbench.training.simulator import (
    ARCHITECTURE,
    MEMBERS,
    SEED,
    TrainingRecordings,
    load_recordings,
)


def test_the_session_with_the_most_breaths_stands_for_a_lung():
    table = Sessions(
        tuple(
            Session(lung, 34.0, False, 30, count)
            for lung, count in (("R5C10", 9), ("R5C20", 7), ("R5C20", 8), ("R5C10", 9))
        )
    )
    assert simulator.reference_session(table, "R5C10") == 0
    assert simulator.reference_session(table, "R5C20") == 2


@pytest.fixture
def data(tmp_path: Path, make_synthetic) -> TrainingRecordings:
    parts = []
    for name, each, first in (("one.csv", 3, 1), ("two.csv", 2, 100)):
        write(make_synthetic(each=each, first_id=first), tmp_path / name)
        parts.append(load(tmp_path / name))
    fold = np.arange(len(parts[0])) % 2
    return TrainingRecordings(parts[0], parts[1], fold, 7)


def test_provenance_is_plain_and_complete(data):
    found = simulator.provenance(
        data, HybridConfig(iterations=20), LearnedConfig(), Architecture(width=4)
    )
    assert tomllib.loads(tomli_w.dumps(found)) == found
    assert found["recordings"] == {
        "one.csv": {"sha256": data.measured.sha256, "breaths": 27},
        "two.csv": {"sha256": data.reconstructed.sha256, "breaths": 18},
    }
    assert found["split"]["seed"] == 7
    assert found["split"]["held_out"] == [list(range(1, 28, 2)), list(range(2, 28, 2))]
    assert found["recipe"]["hybrid"]["iterations"] == 20
    assert found["recipe"]["learned_architecture"]["width"] == 4
    assert set(found["packages"]) == set(simulator.PACKAGES)


def test_judged_by_all_kinds_with_empty_figures_where_there_is_no_breath(make_synthetic):
    """The official simulators on synthetic breaths: all are new to all members."""
    breaths = make_synthetic(each=2)
    found = simulator.evaluate_simulators(
        frozen.load(),
        frozen.load_learned(),
        TrainingRecordings(breaths, breaths, np.zeros(18, int), 0),
    )
    assert tuple(found["lungs"]) == LUNG_IDS
    for name, about in found["lungs"].items():
        assert about["held_out_breaths"] == about["official_breaths"] == 2
        assert not [key for key in about if key.startswith("training_")]
        assert about["held_out_mae"] == about["official_mae"] > 0.0
        assert found["comparison"]["hybrid"][name]["mae"] == about["held_out_mae"]
        assert about["held_out_mae"] == round(about["held_out_mae"], 6)
    assert set(found["comparison"]["two_balloon"]) > set(LUNG_IDS)  # and the three R50 ones
    assert tomllib.loads(tomli_w.dumps(found)) == found


def test_the_official_manifest_is_of_this_training(public_recordings):
    """Recordings, folds, settings and architecture of the code are those of the frozen files."""
    data = load_recordings(public_recordings)
    assert (MEMBERS, SEED) == (5, 0)
    found = simulator.provenance(data, HybridConfig(), LearnedConfig(), ARCHITECTURE)
    official = frozen.load().manifest
    for key in ("format", "version", "kind", "recordings", "split", "recipe"):
        assert official[key] == found[key], key
