"""Plants in files and back, to the bit; what is no plant file is refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base import compilation
from ventbench.base import files as whole_files
from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.physics import physics
from ventbench.plants import frozen, plant_files
from ventbench.plants.corrected import Corrected
from ventbench.plants.plant_files import (
    load_plant,
    load_plants,
    rig_id,
    save_plant,
    save_plants,
)
from ventbench.plants.sensed import Sensed, sensor
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack, stack_heterogeneous, take
from ventbench.plants.two_balloon import two_balloon
from ventbench.task.lungs import LUNGS, lung

PLANTS = {
    "SingleCompartment": lambda: stack([single_compartment(lung) for lung in LUNGS]),
    "TwoBalloon": lambda: two_balloon(LUNGS[0]),
    "Hybrid": lambda: frozen.load().ensemble,
    "Corrected": lambda: Corrected(
        single_compartment(LUNGS[0]),
        physics(LUNGS[0], {"valve_lag": {"tau": 0.04}}),
        physics(LUNGS[0]),
    ),
    "Sensed": lambda: Sensed(single_compartment(LUNGS[0]), sensor({"sensor_lag.tau": 0.05})),
    "Physics": lambda: physics(LUNGS[0], {"leak": {"conductance": 8.0}}),
}


@pytest.mark.parametrize("kind", PLANTS)
def test_back_to_the_bit_with_dtype_shape_and_type(kind, tmp_path):
    plant = PLANTS[kind]()
    path = tmp_path / "plant.npz"
    save_plant(path, plant)
    found = load_plant(path)
    assert type(found).__name__ == kind
    assert jax.tree.structure(found) == jax.tree.structure(plant)
    for leaf, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(plant), strict=True):
        assert isinstance(leaf, np.ndarray | np.generic)
        assert leaf.dtype == np.asarray(wanted).dtype
        np.testing.assert_array_equal(leaf, wanted)


def test_every_family_is_tried():
    families = {family.plant.__name__ for family in plant_files.FAMILIES.values()}
    assert families == set(PLANTS)
    for name in families:
        assert plant_files.stored_type(name).__name__ == name


def test_equal_plants_give_equal_bytes(tmp_path):
    for name in ("one.npz", "two.npz"):
        save_plant(tmp_path / name, two_balloon(LUNGS[0]))
    assert whole_files.sha256(tmp_path / "one.npz") == whole_files.sha256(tmp_path / "two.npz")


def test_what_is_no_array_or_number_is_not_stored(tmp_path):
    with pytest.raises(TypeError, match=r"\.1: a set cannot be stored"):
        save_plant(tmp_path / "plant.npz", (1.0, {2.0}))
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
    save_plant(path, single_compartment(LUNGS[0]))
    altered(path, structure)
    with pytest.raises(InputError, match=r"plant\.npz is not a plant file of ventbench"):
        load_plant(path)


def test_other_files_are_refused(tmp_path):
    text = tmp_path / "text.npz"
    text.write_text("no archive")
    with pytest.raises(InputError, match=r"text\.npz is not a plant file"):
        load_plant(text)
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, structure=np.array({"a": 1}, dtype=object))
    with pytest.raises(InputError, match=r"pickled\.npz is not a plant file"):
        load_plant(pickled)
    with pytest.raises(FileNotFoundError):
        load_plant(tmp_path / "none.npz")


def late(lung_id: str, **base: float):
    with compilation.float64():
        return physics(lung(lung_id), {"valve_delay": {"delay": 1.0 / 24.0}}, **base)


@pytest.mark.parametrize("kind", ["physics", "frozen"])
def test_plants_by_lung_come_back_to_the_bit(kind: str, tmp_path: Path) -> None:
    plants = {
        "R20C50": late("R20C50"),
        rig_id("R20C50", 0.0319): late("R20C50", R_ex=4.1),  # at one of several ventilators
        "R33C7.5": late("R33C7.5", R_ex=6.1),
    }
    if kind == "frozen":
        plants = {item.id: take(frozen.load().plants, i) for i, item in enumerate(LUNGS[:2])}
    path = tmp_path / "corrected.json"
    save_plants(path, plants, {"recording": None})
    found, about = load_plants(path)
    assert about == {"recording": None}
    assert list(found) == list(plants)
    for name, plant in plants.items():
        assert jax.tree.structure(found[name]) == jax.tree.structure(plant)
        leaves, wanted = jax.tree.leaves(found[name]), jax.tree.leaves(plant)
        for leaf, want in zip(leaves, wanted, strict=True):
            assert leaf.dtype == np.asarray(want).dtype
            np.testing.assert_array_equal(leaf, want)
    save_plants(tmp_path / "again.json", plants, {"recording": None})
    assert whole_files.sha256(path) == whole_files.sha256(tmp_path / "again.json")


def test_what_is_no_file_of_plants_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "corrected.json"
    save_plants(path, {"R20C50": late("R20C50")})
    good = json.loads(path.read_text())
    unknown = json.loads(json.dumps(good).replace('"Physics"', '"Popen"'))
    dtype = json.loads(json.dumps(good).replace('"float64"', '"object"', 1))
    label = {**good, "lungs": {"big": good["lungs"]["R20C50"]}}
    clocks = [
        json.dumps({**good, "lungs": {f"R20C50@{interval}": good["lungs"]["R20C50"]}})
        for interval in ("fast", "nanms", "0ms", "-3ms", "infms", "")
    ]
    for text in (
        "",
        "[]",
        "{}",
        json.dumps({**good, "format": "x"}),
        json.dumps({**good, "lungs": {}}),
        json.dumps(unknown),
        json.dumps(dtype),
        json.dumps(label),
        *clocks,
        json.dumps({**good, "arrays": {}}),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=r"corrected\.json is not a file of plants"):
            load_plants(path)


def test_a_parameter_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        save_plants(tmp_path / "x.json", {"R20C50": late("R20C50", gain=np.nan)})
    assert not list(tmp_path.iterdir())


def run(*arguments: object) -> tuple[int, str]:
    found = CliRunner().invoke(app, [*map(str, arguments)])
    if isinstance(found.exception, InputError):  # main() prints it and exits with 2
        return 2, str(found.exception)
    return found.exit_code, found.stdout


def test_score_on_the_plants_of_a_file(tmp_path: Path) -> None:
    """Its lungs are those of the file, and the score is that of the same plants elsewhere."""
    from ventbench.entries.folder import open_submission
    from ventbench.entries.scoring import run_protocol
    from ventbench.plants.rigs import Rigs

    plants = {name: single_compartment(lung(name)) for name in ("R20C20", "R5C10")}
    path = tmp_path / "corrected.json"
    save_plants(path, plants)
    options = ("score", "pid_best", "--simulator", path, "--in-process")
    code, text = run(*options, "--json", "-")
    plain = json.loads(text)
    assert code == 0
    assert list(plain["lungs"]) == ["R20C20", "R5C10"]
    assert plain["official"] is False
    assert plain["simulators"]["sha256"] == whole_files.sha256(path)
    wanted = run_protocol(
        open_submission("pid_best"),
        protocol_of(Rigs(tuple(map(lung, plants)), stack_heterogeneous(list(plants.values())))),
        runner=InProcessRunner(),
    )
    assert plain["score"] == pytest.approx(wanted.score, abs=1e-12)
    code, text = run(*options)
    assert code == 0
    assert "R20C20" in text
    assert "R5C20" not in text
    code, text = run(*options, "--draws", 20, "--record", tmp_path / "records")
    assert code == 2
    assert "leave out --simulator" in text
    assert run("score", "pid_best", "--simulator", "nothing")[0] == 2
