"""The official simulators: what their files hold, what is refused, and who is judged by whom."""

from __future__ import annotations

import shutil
import tomllib
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import files
from ventbench.base.compilation import float64
from ventbench.base.errors import InputError
from ventbench.plants import frozen
from ventbench.plants.frozen import BY_ALL, training_list
from ventbench.task.lungs import LUNG_IDS, LUNGS, RECORDED_LUNGS

NAMES = (frozen.MEMBERS, frozen.TRAINING_LIST)


@pytest.fixture(scope="module")
def official():
    return frozen.load()


@pytest.fixture
def copy(tmp_path):
    return shutil.copytree(frozen.folder(), tmp_path / "simulators")


def test_every_file_is_what_the_manifest_says(official):
    folder = frozen.folder()
    manifest = tomllib.loads((folder / frozen.MANIFEST).read_text("utf-8"))
    assert {path.name for path in folder.iterdir()} == {
        *NAMES,
        frozen.MANIFEST,
        frozen.POPULATION,
        frozen.ROLES,
    }
    assert files.sha256(folder / frozen.ROLES) == frozen.ROLES_SHA256
    hashes = {name: files.sha256(folder / name) for name in NAMES}
    assert manifest["files"][frozen.MEMBERS]["sha256"] == hashes[frozen.MEMBERS]
    assert hashes[frozen.TRAINING_LIST] == frozen.TRAINING_LIST_SHA256
    about = official.about()
    assert about == {
        "version": 2,
        "kind": "hybrid",
        "manifest_sha256": files.sha256(folder / frozen.MANIFEST),
        "files": {name: manifest["files"][name]["sha256"] for name in NAMES},
    }


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("where", [0.02, 0.5, 0.98])
def test_one_flipped_bit_is_refused_and_the_file_named(copy, name, where):
    content = bytearray((copy / name).read_bytes())
    content[int(where * len(content))] ^= 1
    (copy / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"{name} has SHA-256 .* the manifest says .* damaged"):
        frozen.load(path=copy)


@pytest.mark.parametrize("name", NAMES)
def test_a_missing_file_is_named(copy, name):
    (copy / name).unlink()
    with pytest.raises(InputError, match=f"{name} is missing"):
        frozen.load(path=copy)


def test_a_file_that_the_manifest_lacks_is_named(copy):
    text = (copy / frozen.MANIFEST).read_text("utf-8")
    (copy / frozen.MANIFEST).write_text(text.replace('[files."seen.npz"]', '[files."other.npz"]'))
    with pytest.raises(InputError, match=r"seen\.npz is missing, or the manifest lacks it"):
        frozen.load(path=copy)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read"),
        ("version = ", "cannot be read"),
        ("version = 1\n", "key format: None is not 'ventbench-simulators-2'"),
        ('format = "ventbench-simulators-1"\n', "reads no other"),
    ],
)
def test_a_wrong_manifest_is_refused(copy, text, message):
    (copy / frozen.MANIFEST).unlink()
    if text is not None:
        (copy / frozen.MANIFEST).write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        frozen.load(copy)
    assert frozen.MANIFEST in str(refused.value)


def test_shapes_and_precision(official):
    sessions = len(official.sessions)
    for plants, shape in (
        (official.plants, (6,)),
        (official.ensemble, (6, 6)),
        (official.members, (6, sessions)),
    ):
        leaves = jax.tree.leaves(plants)
        assert all(isinstance(leaf, np.ndarray) and leaf.dtype == np.float64 for leaf in leaves)
        assert all(leaf.shape[: len(shape)] == shape for leaf in leaves)
        assert all(np.isfinite(leaf).all() for leaf in leaves)


def test_the_first_of_the_ensemble_is_official(official):
    first = jax.tree.map(lambda leaf: leaf[0], official.ensemble)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(official.plants), strict=True):
        np.testing.assert_array_equal(a, b)
    # The others were trained on other breaths.
    assert all(np.ptp(official.ensemble.E, axis=0) > 0)


def test_stiffness_and_resistance_are_in_the_order_of_the_labels(official):
    """Not equal to the labels: what was set up at the bench differs, and a filter adds to R."""
    plants = official.plants
    elastance = plants.E.reshape(2, 3)
    assert (np.diff(elastance, axis=1) < 0).all()
    np.testing.assert_allclose(elastance, [[1000.0 / x.C for x in LUNGS[:3]]] * 2, rtol=0.2)
    assert (plants.R[3:] > 2.0 * plants.R[:3]).all()


def test_lungs_tells_settings_and_errors(official):
    lungs = official.lungs()
    assert tuple(lungs) == LUNG_IDS
    for setting, about in zip(LUNGS, lungs.values(), strict=True):
        assert (about["R"], about["C"]) == (setting.R, setting.C)
        low, high = about["held_out_ci95"]
        assert 0.0 < low < about["held_out_mae"] < high
        assert official.sessions.table[about["session"]].lung == setting.id
    lungs["R5C10"]["R"] = 0.0  # a copy
    assert official.lungs()["R5C10"]["R"] == 5.0


def same(plant, other):
    leaves = zip(jax.tree.leaves(plant), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(a, b) for a, b in leaves)


def test_a_breath_gets_its_lung_on_the_rig_of_its_clock(official, make_recording):
    """For each session a breath with its clock; sessions of one lung differ."""
    table = official.sessions.table
    breaths = make_recording(
        [s.lung for s in table],
        [s.interval_ms for s in table],
        inspiratory=[s.inspiratory for s in table],
        late=[0.1 * s.spiky for s in table],
    )
    order = np.random.default_rng(0).permutation(len(table))
    with float64():
        found = official.for_breaths(breaths.select(order))
    wanted = jax.tree.map(lambda leaf: leaf[0, order], official.members)
    assert same(found, wanted)
    assert found.R.dtype == np.float64
    single = official.for_breaths(breaths)
    assert single.R.dtype == jnp.float32.dtype  # the precision in force
    assert len(np.unique(official.members.E[0])) == len(table)


def test_an_unknown_lung_is_refused_with_the_known_ones(official, make_recording):
    breaths = make_recording(["R5C10", "R5C30"])
    known = ", ".join(lung.id for lung in RECORDED_LUNGS)
    for find in (official.for_breaths, official.cross_fitted):
        with pytest.raises(InputError, match=f"lung R5C30.*known are {known}"):
            find(breaths)


def test_who_has_seen_a_breath_decides_who_judges_it(official, make_recording):
    breaths = make_recording(["R5C10"] * 7)
    folds = np.array([1, 2, 3, 4, 5, BY_ALL])  # of the first six; the last is new
    simulators = replace(
        official, training_breaths=training_list(breaths.select(np.arange(6)), folds)
    )
    assert simulators.held_out(breaths).tolist() == [True] * 5 + [False, True]
    assert simulators.unseen(breaths).tolist() == [False] * 6 + [True]
    judges = [1, 2, 3, 4, 5, 0, 0]
    at = int(official.sessions.assign(breaths)[0])
    with float64():
        assert same(
            simulators.cross_fitted(breaths),
            jax.tree.map(lambda leaf: leaf[judges, at], official.members),
        )
