"""From any folder of recordings to simulators that every ``--simulator`` takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ventbench
from ventbench.base.errors import InputError
from ventbench.physics import physics
from ventbench.plants import frozen
from ventbench.plants.catalog import load_simulators
from ventbench.recordings import Breaths, join, load, write
from ventbench.task.lungs import Lung, lung
from ventbench.train.exploration import ExplorationRanges, SimulatedVentilator, explore
from ventbench.train.rigs.data import load_rig_recordings
from ventbench.train.rigs.fit import FitConfig
from ventbench.train.rigs.train import RigConfig, train_rigs

#: A lung that no simulator of ours was made for.
OWN = Lung(9.0, 33.0)
#: Its resistance is linear.
CONFIG = RigConfig(folds=2, resamples=2, laminar_share=1.0, fit=FitConfig(iterations=20))
RANGES = ExplorationRanges((1.0, 3.0, 0.0), (30.0, 60.0), (0.4, 0.8), (-20.0, 40.0))


def recorded(label: Lung, breaths: int = 6, seed: int = 0) -> Breaths:
    """Breaths of an R-C lung that is what its label says."""
    ventilator = SimulatedVentilator(physics(label), breaths, noise=0.1, seed=seed)
    return explore(ventilator, label.id, breaths, seed=seed, ranges=RANGES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two files of breaths, one breath of which is in both, and a file of something else."""
    out = tmp_path_factory.mktemp("own")
    first, second = recorded(OWN), recorded(OWN, seed=1)
    write(first, out / "monday.csv")
    again = replace(first.select([0]), breath_id=np.array([99]))
    write(join([second, again]), out / "tuesday.parquet")
    (out / "notes.csv").write_text("day,remark\n1,warm\n")
    (out / "README.md").write_text("my recordings\n")
    return out


def test_every_file_in_the_schema_is_read_and_a_breath_counts_once(folder):
    data = load_rig_recordings(folder, folds=CONFIG.folds, seed=CONFIG.seed)
    assert data.labels == (OWN,)
    assert {name: about["breaths"] for name, about in data.sources.items()} == {
        "monday.csv": 6,
        "tuesday.parquet": 7,
    }
    assert data.skipped == ("notes.csv",)
    assert len(data.breaths) == data.measured == 12
    assert len(set(data.breaths.breath_id.tolist())) == 12


def test_breaths_with_blanks_are_no_measured_ones(tmp_path):
    breaths = recorded(OWN, 8)
    pressure = breaths.pressure.copy()
    pressure[:2, 5] = np.nan
    pressure[2, -1] = np.nan  # as the last of the reconstructed ones, in expiration only
    write(replace(breaths, pressure=pressure), tmp_path / "a.csv")
    data = load_rig_recordings(tmp_path, folds=CONFIG.folds, seed=CONFIG.seed)
    assert (len(data.breaths), data.measured) == (8, 5)
    assert np.isfinite(data.measured_breaths.pressure).all()


def test_copies_with_fewer_digits_count_once_and_repeats_lie_in_one_fold(tmp_path):
    breaths = recorded(OWN, 8)
    copies = replace(breaths.select([2, 5]), pressure=np.round(breaths.pressure[[2, 5]], 2))
    repeats = [
        replace(breaths.select([k]), pressure=breaths.pressure[[k]] + shift)
        for k in (0, 1, 2)
        for shift in (0.3, -0.3)
    ]
    write(replace(join([breaths, *repeats]), breath_id=np.arange(14)), tmp_path / "a.csv")
    write(copies, tmp_path / "b.csv")
    data = load_rig_recordings(tmp_path, folds=CONFIG.folds, seed=CONFIG.seed)
    assert len(data.breaths) == data.measured == 14
    for k in range(3):
        assert len(set(data.fold[[k, 8 + 2 * k, 9 + 2 * k]].tolist())) == 1
    assert set(data.fold.tolist()) == {0, 1}


def test_what_cannot_be_learned_from_is_told(tmp_path):
    with pytest.raises(InputError, match="no recording in the public schema"):
        load_rig_recordings(tmp_path, folds=CONFIG.folds, seed=CONFIG.seed)
    write(recorded(OWN, 3), tmp_path / "few.csv")
    with pytest.raises(InputError, match="3 breaths without a blank pressure; 4 or more"):
        load_rig_recordings(tmp_path, folds=CONFIG.folds, seed=CONFIG.seed)
    write(recorded(OWN, 6), tmp_path / "few.csv")
    with pytest.raises(InputError, match="lung R5C10 was not recorded; recorded are R9C33"):
        train_rigs(tmp_path, tmp_path / "out", lungs=["R5C10"], config=CONFIG)


def test_a_damaged_recording_is_refused_and_not_skipped(tmp_path):
    write(recorded(OWN, 6), tmp_path / "a.csv")
    text = (tmp_path / "a.csv").read_text().splitlines()
    text[5] = text[5].replace(",0,", ",7,", 1)
    (tmp_path / "b.csv").write_text("\n".join([*text, "1,2"]) + "\n")
    with pytest.raises(InputError, match=r"b\.csv"):
        load_rig_recordings(tmp_path, folds=CONFIG.folds, seed=CONFIG.seed)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, folder):
    out = tmp_path_factory.mktemp("trained") / "rig"
    told = []
    config = replace(CONFIG, fit=FitConfig(iterations=160))
    return out, train_rigs(folder, out, config=config, progress=lambda *x: told.append(x)), told


def test_the_lung_is_what_it_was(trained):
    _, simulators, _ = trained
    assert simulators.lung_ids == (OWN.id,)
    (test,) = [t for t in simulators.manifest["label_tests"] if t["session"] == 0]
    assert test["C"] == pytest.approx(OWN.C, rel=0.1)
    about = simulators.lungs()[OWN.id]
    # Tubes of 1 cmH2O/(L/s) are a ninth of its resistance, and leave the valve's gain as open.
    assert about["label_test"] == "cannot be told"
    assert "reason" not in test
    assert "to 11 % only" in test["doubt"]
    assert about["own_rig_median_mae"] < 0.8


def test_the_resistance_is_what_it_was(trained):
    """Its prior is that of a linear resistor: a dozen breaths tell little of the laminar share."""
    _, simulators, _ = trained
    (test,) = [t for t in simulators.manifest["label_tests"] if t["session"] == 0]
    assert test["R"] == pytest.approx(OWN.R, rel=0.2)


def test_a_laminar_share_is_a_share():
    with pytest.raises(InputError, match=r"laminar share 1\.2 is outside 0\.\.1"):
        RigConfig(laminar_share=1.2)


def test_the_folder_is_a_plant_for_everything(trained, folder):
    out, simulators, _ = trained
    plants = load_simulators(str(out))
    assert plants.lungs == (OWN,)
    rise = plants.respond(
        OWN.id, np.full(30, 20.0), np.zeros(30), np.full(30, 0.03), initial_pressure=5.0
    )
    assert rise[-1] > rise[5] > 5.0
    report = ventbench.open_loop(load(folder / "monday.csv"), out)
    assert report.lungs[OWN.id]["mae"] < 1.0
    grid, _ = ventbench.tune_pid(simulator=out, gains=[(1.0, 3.0, 0.0), (0.0, 0.0, 0.0)], draws=0)
    assert grid.best(OWN.id)[0] == (1.0, 3.0, 0.0)
    assert frozen.load(path=out).manifest_sha256 == simulators.manifest_sha256


def test_progress_and_nothing_left_behind(trained):
    out, _, told = trained
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert {path.name for path in out.iterdir()} == {
        frozen.MANIFEST,
        frozen.MEMBERS,
        frozen.TRAINING_LIST,
    }


def test_an_interrupted_training_goes_on_to_the_same_bytes(tmp_path, folder):
    def stop(what: str, share: float) -> None:
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_rigs(folder, tmp_path / "a", config=CONFIG, progress=stop)
    assert list((tmp_path / "a" / "parts").glob("*.npz"))
    for name in ("a", "b"):
        train_rigs(folder, tmp_path / name, config=CONFIG)
    for name in (frozen.MANIFEST, frozen.MEMBERS, frozen.TRAINING_LIST):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert lung(OWN.id) == OWN
