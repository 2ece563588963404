"""From recordings to the files of the simulators: the same bytes, also after Ctrl-C."""

from __future__ import annotations

import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from ventbench import open_loop_report
from ventbench.errors import InputError
from ventbench.lungs import LUNG_IDS
from ventbench.plants import frozen
from ventbench.plants.learned import Architecture
from ventbench.recordings import load, write
from ventbench.training import simulator
from ventbench.training.hybrid.fit import HybridConfig
from ventbench.training.learned import LearnedConfig

CONFIG = HybridConfig(iterations=20)
NETWORK_CONFIG = LearnedConfig(steps=2, batch=2)
TINY = Architecture(pressures=2, controls=2, width=4, depth=2, boundaries=1, boundary_width=4)
NAMES = (frozen.MANIFEST, frozen.MEMBERS, frozen.LEARNED, frozen.SEEN)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, make_synthetic):
    """Both files of the public recordings, of synthetic breaths."""
    folder = tmp_path_factory.mktemp("recordings")
    write(make_synthetic(each=4), folder / simulator.MEASURED)
    more = make_synthetic(each=2, seed=1, first_id=1000)
    pressure = np.where(more.inspiratory, more.pressure, np.nan)
    pressure[:, 0] = np.nan
    write(replace(more, pressure=pressure), folder / simulator.RECONSTRUCTED)
    return folder


def train(recordings, out, progress=None, config=CONFIG):
    """Two members and tiny networks: what is tested is how the parts come together."""
    return simulator.train_simulator(
        recordings, out, config=config, network_config=NETWORK_CONFIG, architecture=TINY,
        members=2, progress=progress,
    )  # fmt: skip


@pytest.fixture(scope="module")
def trained(recordings, tmp_path_factory):
    told = []
    out = tmp_path_factory.mktemp("trained")
    simulators = train(recordings, out, lambda *x: told.append(x))
    return out, simulators, told


@pytest.mark.slow
def test_writes_all_files_and_nothing_else(trained):
    out, simulators, _ = trained
    assert sorted(path.name for path in out.iterdir()) == sorted(NAMES)
    assert simulators.about() == frozen.load(path=out).about()
    assert jax.tree.leaves(simulators.members)[0].shape[:2] == (2, 9)
    assert simulators.plants.R.shape == (6,)
    assert frozen.load_learned(path=out).seen.key.shape == simulators.seen.key.shape


@pytest.mark.slow
def test_tells_how_far_it_is(trained):
    _, _, told = trained
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    texts = [what for what, _ in told]
    assert {"hybrid, member 1", "network R50C50, member 1", "done"} <= set(texts)


@pytest.mark.slow
def test_the_manifest_tells_data_split_recipes_and_packages(trained, recordings):
    _, simulators, _ = trained
    manifest = simulators.manifest
    measured = load(recordings / simulator.MEASURED)
    assert manifest["recordings"][simulator.MEASURED] == {"sha256": measured.sha256, "breaths": 36}
    assert manifest["recordings"][simulator.RECONSTRUCTED]["breaths"] == 18
    assert manifest["recipe"]["hybrid"]["iterations"] == 20
    assert manifest["recipe"]["learned"]["batch"] == 2
    assert manifest["recipe"]["learned_architecture"]["width"] == 4
    assert set(manifest["packages"]) == {"flax", "jax", "jaxlib", "numpy", "optax"}
    first, second = manifest["split"]["held_out"]
    assert sorted(first + second) == measured.breath_id.tolist()
    fold = simulators.seen.folds(measured)
    assert sorted(measured.breath_id[fold == 1].tolist()) == second


@pytest.mark.slow
def test_the_errors_it_writes_are_those_of_the_simulators_it_writes(trained, recordings):
    _, simulators, _ = trained
    measured = load(recordings / simulator.MEASURED)
    held_out = open_loop_report.errors(simulators.cross_fitted, measured)
    official = open_loop_report.errors(simulators.for_breaths, measured)
    for name in LUNG_IDS:
        index = measured.by_lung_index[name]
        about = simulators.lungs()[name]
        assert about["held_out_mae"] == pytest.approx(held_out[index].mean(), abs=1e-5)
        assert about["held_out_breaths"] == about["official_breaths"] + about["training_breaths"]
        new = simulators.unseen(measured)[index]
        assert about["official_mae"] == pytest.approx(official[index][new].mean(), abs=1e-5)
    assert set(simulators.manifest["comparison"]) == {
        "hybrid", "learned", "single_compartment", "two_balloon",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("stop_at", ["hybrid, member 1", "network R20C20, member 1"])
def test_goes_on_after_ctrl_c_to_the_same_bytes(trained, recordings, tmp_path, stop_at):
    whole = trained[0]

    def stop(what, share):
        if what == stop_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(recordings, tmp_path, stop)
    assert [path.name for path in tmp_path.iterdir()] == ["parts"]
    done = {path.name for path in (tmp_path / "parts").iterdir()}
    assert "hybrid-0.npz" in done
    assert ("hybrid-1.npz" in done) == stop_at.startswith("network")
    train(recordings, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(NAMES)
    for name in NAMES:
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes(), name


def test_parts_of_another_training_are_refused_before_anything_is_done(recordings, tmp_path):
    def stop(what, share):
        if what.startswith("hybrid"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(recordings, tmp_path, stop)
    with pytest.raises(
        InputError, match=r"parts holds work with other settings \(recipe\); delete it"
    ):
        train(recordings, tmp_path, config=replace(CONFIG, learning_rate=0.04))
    other = shutil.copytree(recordings, tmp_path / "other")
    breaths = load(other / simulator.MEASURED)
    pressure = breaths.pressure.copy()
    pressure[0, 3] += 0.001
    write(replace(breaths, pressure=pressure), other / simulator.MEASURED)
    with pytest.raises(InputError, match=r"other settings \(recordings\)"):
        train(other, tmp_path)


def test_a_missing_recording_is_an_error(tmp_path):
    with pytest.raises(InputError, match=rf"{simulator.MEASURED}: there is no such file"):
        train(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
