"""Every kind of plant in a file and back; what is no plant file is refused by name."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench import files as whole_files
from ventbench.errors import InputError
from ventbench.lungs import LUNGS
from ventbench.physics import physics
from ventbench.plants import files, frozen, registry
from ventbench.plants.corrected import Corrected
from ventbench.plants.learned import Architecture, learned
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stack import stack, take
from ventbench.plants.two_balloon import two_balloon

SMALL = Architecture(pressures=3, controls=4, width=8, depth=2, boundaries=1, boundary_width=4)
PLANTS = {
    "SingleCompartment": lambda: stack([single_compartment(lung) for lung in LUNGS]),
    "TwoBalloon": lambda: two_balloon(LUNGS[0]),
    "Learned": lambda: learned(jax.random.key(0), SMALL),
    "Hybrid": lambda: frozen.load().ensemble,
    "Corrected": lambda: Corrected(
        single_compartment(LUNGS[0]), physics(LUNGS[0], {"valve_lag": {"tau": 0.04}}),
        physics(LUNGS[0]),
    ),
    "Physics": lambda: physics(LUNGS[0], {"leak": {"conductance": 8.0}}),
}  # fmt: skip


@pytest.mark.parametrize("kind", PLANTS)
def test_back_to_the_bit_with_dtype_shape_and_type(kind, tmp_path):
    plant = PLANTS[kind]()
    path = tmp_path / "plant.npz"
    files.save(path, plant)
    found = files.load(path, as_array=np.asarray)
    assert type(found).__name__ == kind
    assert jax.tree.structure(found) == jax.tree.structure(plant)
    for leaf, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(plant), strict=True):
        assert isinstance(leaf, np.ndarray | np.generic)
        assert leaf.dtype == np.asarray(wanted).dtype
        np.testing.assert_array_equal(leaf, wanted)


def test_every_type_of_plant_is_tried_and_known():
    parts = {"Boundary", "MLP"}  # parts of a learned plant, and so in its file
    assert set(registry.TYPES) == set(PLANTS) | parts


def test_equal_plants_give_equal_bytes(tmp_path):
    for name in ("one.npz", "two.npz"):
        files.save(tmp_path / name, two_balloon(LUNGS[0]))
    assert whole_files.sha256(tmp_path / "one.npz") == whole_files.sha256(tmp_path / "two.npz")


def test_by_default_the_leaves_take_the_precision_in_force(tmp_path):
    path = tmp_path / "plant.npz"
    files.save(path, take(frozen.load().plants, 0))
    leaves = jax.tree.leaves(files.load(path))
    assert {leaf.dtype for leaf in leaves} == {jnp.float32.dtype}
    with jax.enable_x64(True):
        assert files.load(path).R.dtype == np.float64


def test_what_is_no_array_or_number_is_not_stored(tmp_path):
    with pytest.raises(TypeError, match=r"\.1: a set cannot be stored"):
        files.save(tmp_path / "plant.npz", (1.0, {2.0}))
    assert not list(tmp_path.iterdir())


def altered(path, structure):
    with np.load(path) as arrays:
        content = {name: arrays[name] for name in arrays.files}
    content["structure"] = np.array(structure)
    np.savez(path, **content)


@pytest.mark.parametrize(
    "structure",
    [
        "{",
        json.dumps({"type": "Popen", "fields": {}}),
        json.dumps({"type": "SingleCompartment", "fields": {}}),
        json.dumps({"type": "SingleCompartment", "fields": {"R": {"array": "nowhere"}}}),
        json.dumps({"something": 1}),
    ],
)
def test_a_wrong_structure_is_refused(structure, tmp_path):
    path = tmp_path / "plant.npz"
    files.save(path, single_compartment(LUNGS[0]))
    altered(path, structure)
    with pytest.raises(InputError, match=r"plant\.npz is not a plant file of ventbench"):
        files.load(path)


def test_other_files_are_refused(tmp_path):
    text = tmp_path / "text.npz"
    text.write_text("no archive")
    with pytest.raises(InputError, match=r"text\.npz is not a plant file"):
        files.load(text)
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, structure=np.array({"a": 1}, dtype=object))
    with pytest.raises(InputError, match=r"pickled\.npz is not a plant file"):
        files.load(pickled)
    with pytest.raises(FileNotFoundError):
        files.load(tmp_path / "none.npz")
