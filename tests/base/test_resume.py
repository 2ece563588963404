"""Finished work is kept, and belongs to one set of settings."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base.errors import InputError
from ventbench.base.resume import ARRAY, JSON, SETTINGS, Checkpoint, WorkFolder, fingerprint

RECIPE = {"recipe": {"updates": 20, "gains": (1.0, 2.0)}, "seed": 0}
OTHERS = {
    "none": ({}, "recipe, seed"),
    "changed": (RECIPE | {"recipe": {"updates": 40}}, "recipe"),
    "added": (RECIPE | {"jax": "0.10"}, "jax"),
}
other_settings = pytest.mark.parametrize(("other", "named"), OTHERS.values(), ids=OTHERS)


@pytest.mark.parametrize(
    ("value", "form"), [([0.1, 0.2], JSON), (np.arange(3.0), ARRAY)], ids=["json", "array"]
)
def test_a_result_is_computed_once(tmp_path, value, form):
    computed = []

    def compute():
        computed.append(1)
        return value

    for _ in range(2):
        np.testing.assert_array_equal(WorkFolder(tmp_path, RECIPE).get("a", compute, form), value)
    assert computed == [1]
    work = WorkFolder(tmp_path, RECIPE)
    assert work.has("a", form)
    assert not work.has("b", form)
    work.delete()
    assert not tmp_path.exists()


def test_an_interruption_leaves_no_result(tmp_path):
    work = WorkFolder(tmp_path, RECIPE)

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work.get("a", interrupt)
    assert [path.name for path in tmp_path.iterdir()] == [SETTINGS]
    assert work.checkpoint("a").parent == tmp_path
    with pytest.raises(FileNotFoundError):
        work.read("a")


@other_settings
def test_a_folder_of_other_settings_is_refused_and_kept(tmp_path, other, named):
    WorkFolder(tmp_path, RECIPE)
    before = (tmp_path / SETTINGS).read_bytes()
    with pytest.raises(InputError, match=rf"{tmp_path.name} holds .* \({named}\); delete it"):
        WorkFolder(tmp_path, other)
    assert (tmp_path / SETTINGS).read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"[1, 2"], ids=["empty", "cut off"])
@pytest.mark.parametrize("form", [JSON, ARRAY], ids=["json", "array"])
def test_a_damaged_result_is_named(tmp_path, form, content):
    work = WorkFolder(tmp_path, RECIPE)
    work.path("a", form).write_bytes(content)
    with pytest.raises(InputError, match=rf"a\{form.suffix} is damaged, delete it"):
        work.read("a", form)


def state() -> dict:
    return {"key": jax.random.key(3), "net": (jnp.ones(2), jnp.zeros((), int)), "curve": np.ones(4)}


def test_a_checkpoint_restores_arrays_keys_and_progress(tmp_path):
    path = tmp_path / "new" / "state.npz"
    start = state()
    assert Checkpoint(path, RECIPE).restore(start) == (start, 0)
    later = start | {"key": jax.random.key(8), "net": (2 * jnp.ones(2), jnp.asarray(7))}
    Checkpoint(path, RECIPE).save(later, 40)
    restored, done = Checkpoint(path, RECIPE).restore(start)
    assert done == 40
    assert jax.tree.structure(restored) == jax.tree.structure(later)
    assert jnp.array_equal(jax.random.key_data(restored["key"]), jax.random.key_data(later["key"]))
    assert isinstance(restored["curve"], np.ndarray)
    np.testing.assert_array_equal(restored["net"][0], 2.0)
    assert int(restored["net"][1]) == 7
    Checkpoint(path, RECIPE).delete()
    assert not path.exists()


def test_without_a_path_nothing_is_stored():
    checkpoint = Checkpoint(None, RECIPE)
    checkpoint.save(state(), 3)
    assert checkpoint.restore(1.0) == (1.0, 0)
    checkpoint.delete()


@other_settings
def test_a_checkpoint_of_other_settings_is_refused(tmp_path, other, named):
    path = tmp_path / "state.npz"
    Checkpoint(path, RECIPE).save(state(), 3)
    with pytest.raises(InputError, match=rf"state\.npz holds work .* \({named}\); delete it"):
        Checkpoint(path, other).restore(state())


@pytest.mark.parametrize("size", [0, 10, 200])
def test_a_damaged_checkpoint_is_named(tmp_path, size):
    path = tmp_path / "state.npz"
    Checkpoint(path, RECIPE).save(state(), 3)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(InputError, match=r"state\.npz is not a checkpoint"):
        Checkpoint(path, RECIPE).restore(state())


def test_a_fingerprint_is_of_values_types_and_shapes():
    ones = np.ones((2, 3), np.float32)
    same = fingerprint({"a": ones})
    assert same == fingerprint({"a": jnp.ones((2, 3), jnp.float32)})
    others = [ones.reshape(3, 2), ones.astype(float), np.where(np.arange(3) == 1, 2, ones)]
    assert len({same, *(fingerprint({"a": array}) for array in others)}) == 4
