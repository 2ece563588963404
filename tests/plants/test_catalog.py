"""One resolver for every simulator: names, files, functions, arrays; and what each can do."""

from __future__ import annotations

import dataclasses
import sys
from functools import partial

import jax
import numpy as np
import pytest

from ventbench.base import compilation, files
from ventbench.base.errors import InputError
from ventbench.plants import frozen
from ventbench.plants.catalog import load_simulators, names
from ventbench.plants.plant_files import save_plants
from ventbench.plants.python_simulators import PythonSimulators
from ventbench.plants.simulators import FrozenSimulators, SimulatedPressures
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants, open_loop_breaths
from ventbench.plants.two_balloon import two_balloon
from ventbench.recordings import write
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNGS, Lung, lung

single_compartments = partial(nominal_plants, single_compartment)
two_balloons = partial(nominal_plants, two_balloon)


SETTINGS = ["R20C50", "R5C10", "R20C50"]


def first_order(u_in, u_out, dt, *, R, C, initial_pressure):
    """Exact R-C lung of constant commands, in numpy; the expiratory valve does nothing."""
    flow = 22.8 * u_in / 1000.0
    volume = np.concatenate([[0.0], np.cumsum(flow * dt)[:-1]])
    pressure = initial_pressure + volume / (C / 1000.0) + R * np.concatenate([[0.0], flow[:-1]])
    return np.where(np.arange(len(u_in)) == 0, initial_pressure, pressure)


@pytest.fixture
def breaths(make_recording):
    return make_recording(SETTINGS)


def closed(breaths):
    """The breaths with a closed expiratory valve, which is all that `first_order` knows."""
    return dataclasses.replace(breaths, u_out=np.zeros_like(breaths.u_out))


@pytest.mark.parametrize("name", names())
def test_every_name_has_plants_for_lungs_and_for_breaths(name, breaths):
    found = load_simulators(name)
    assert found.has_plants
    assert found.lungs == LUNGS
    assert all(np.shape(leaf)[0] == 6 for leaf in jax.tree.leaves(found.stacked))
    assert isinstance(found.plant("R20C50"), Plant)
    answers = found.pressures(breaths)
    assert answers.shape == breaths.pressure.shape
    assert np.all(np.isfinite(answers))
    np.testing.assert_array_equal(answers[:, 0], breaths.pressure[:, 0])
    alone = found.plant_of_breath(breaths, 1)
    pairs = zip(jax.tree.leaves(alone), jax.tree.leaves(found.for_breaths(breaths)), strict=True)
    assert all(np.ndim(leaf) < np.ndim(stacked) for leaf, stacked in pairs)
    assert load_simulators(found) is found


def test_the_named_ones_are_what_they_say(breaths):
    official = load_simulators("frozen")
    assert official.about == frozen.load().about()
    assert official.sha256 == frozen.load().manifest_sha256
    base = load_simulators("physics")
    assert base.is_base_physics
    assert float(base.plant("R20C50").get("C")) == 50.0  # type: ignore[attr-defined]
    wanted = open_loop_breaths(single_compartments, breaths)
    np.testing.assert_array_equal(base.pressures(breaths), wanted)
    wanted = open_loop_breaths(two_balloons, breaths)
    np.testing.assert_array_equal(load_simulators("two_balloon").pressures(breaths), wanted)


def test_a_folder_is_known_by_its_manifest(tmp_path):
    found = load_simulators(frozen.folder())
    assert found.sha256 == frozen.MANIFEST_SHA256
    for path in frozen.folder().iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with open(tmp_path / frozen.MANIFEST, "a") as file:
        file.write("# another\n")
    other = load_simulators(str(tmp_path))
    assert type(other) is FrozenSimulators
    assert other.sha256 != found.sha256


def test_plants_by_lung_from_a_mapping_and_a_file(breaths, tmp_path):
    with compilation.float64():
        plants = {name: single_compartment(lung(name)) for name in ("R20C50", "R5C10")}
    given = load_simulators(plants)
    assert given.sha256 == load_simulators(dict(plants)).sha256
    assert given.sha256 != load_simulators({"R20C50": plants["R20C50"]}).sha256
    np.testing.assert_allclose(
        given.pressures(breaths), load_simulators("physics").pressures(breaths), atol=1e-9
    )
    path = tmp_path / "corrected.json"
    save_plants(path, plants)
    found = load_simulators(path)
    assert found.lungs == (lung("R20C50"), lung("R5C10"))
    assert found.about == {"kind": "file", "file": path.name, "sha256": files.sha256(path)}
    np.testing.assert_array_equal(found.pressures(breaths), given.pressures(breaths))
    with pytest.raises(InputError, match=r"no lung R5C10 of the recording .*; it has R20C50"):
        load_simulators({"R20C50": plants["R20C50"]}).pressures(breaths)
    with pytest.raises(InputError, match=r"the simulators corrected\.json have R20C50, R5C10"):
        found.plant("R5C50")
    with pytest.raises(InputError, match="a dict is no plant"):
        load_simulators({"R20C50": {}})  # type: ignore[dict-item]


def test_a_lung_at_several_ventilators_is_told_by_the_clock(breaths):
    with compilation.float64():
        slow, fast = (single_compartment(lung(name)) for name in ("R20C50", "R20C20"))
    one = breaths.select(np.flatnonzero(breaths.lung_ids == "R20C50")[:1])
    both = load_simulators({"R20C50": slow, "R20C50@31.9ms": fast, "R20C50@34ms": slow})
    assert both.lungs == (lung("R20C50"),)
    with pytest.raises(InputError, match="R20C50 is there at ventilators alone"):
        load_simulators({"R20C50@31.9ms": fast})
    for interval, plant in ((0.0317, fast), (0.0345, slow)):
        dt = np.where(one.valid, interval, 0.0)
        sampled = dataclasses.replace(one, dt=dt, time=np.cumsum(dt, axis=1) - dt)
        np.testing.assert_array_equal(
            both.pressures(sampled), load_simulators({"R20C50": plant}).pressures(sampled)
        )


def test_one_plant_is_every_lung(breaths):
    plant = single_compartment(lung("R5C10"))
    found = load_simulators(plant)
    assert all(np.shape(leaf) == (6,) for leaf in jax.tree.leaves(found.stacked))
    alike = dataclasses.replace(breaths, R=np.full(3, 5.0), C=np.full(3, 10.0))
    wanted = load_simulators("physics").pressures(alike)
    np.testing.assert_allclose(found.pressures(breaths), wanted, atol=1e-4)


def test_a_function_of_commands(breaths):
    found = load_simulators(first_order)
    assert (type(found), found.name) == (PythonSimulators, "first_order")
    same = closed(breaths)
    wanted = load_simulators("physics").pressures(same)
    np.testing.assert_allclose(found.pressures(same), wanted, atol=1e-9)
    u_in, zeros, dt = np.full(20, 8.0), np.zeros(20), np.full(20, 0.03)
    answer = found.respond("R12C33", u_in, zeros, dt, initial_pressure=5.0)
    np.testing.assert_array_equal(
        answer, first_order(u_in, zeros, dt, R=12.0, C=33.0, initial_pressure=5.0)
    )
    blank = breaths.pressure.copy()
    blank[1, 0] = np.nan
    answers = found.pressures(dataclasses.replace(breaths, pressure=blank))
    assert np.isnan(answers[1]).all()
    assert np.isfinite(np.delete(answers, 1, axis=0)).all()
    with pytest.raises(InputError, match=r"function of whole commands, .* closed loop"):
        _ = found.stacked
    with pytest.raises(InputError, match="not a plant with init and step"):
        found.for_breaths(breaths)


def test_a_function_that_fails_is_told_by_its_breath(breaths):
    def divides(u_in, u_out, dt, *, R, C, initial_pressure):
        raise ZeroDivisionError("no volume")

    with pytest.raises(InputError, match=r"divides raised ZeroDivisionError at breath \d+ of lung"):
        load_simulators(divides).pressures(breaths)
    with pytest.raises(InputError, match=r"shape \(3,\); a pressure for each of the"):
        load_simulators(lambda *_, **__: np.zeros(3)).pressures(breaths)
    with pytest.raises(InputError, match="not finite"):
        load_simulators(lambda u_in, *_, **__: u_in * np.nan).pressures(breaths)


def test_module_and_name(breaths, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_simulators.py").write_text(
        "from ventbench.task.lungs import lung\n"
        "from ventbench.plants.single_compartment import single_compartment\n"
        "def linear(u_in, u_out, dt, *, R, C, initial_pressure):\n"
        "    return initial_pressure + 0.1 * u_in\n"
        "one = single_compartment(lung('R5C10'))\n"
        "by_lung = {'R5C10': one}\n"
        "number = 3\n"
    )
    before = list(sys.path)
    found = load_simulators("my_simulators:linear")
    assert found.sha256 == files.sha256(tmp_path / "my_simulators.py")
    answers = found.pressures(breaths)
    np.testing.assert_allclose(answers, breaths.pressure[:, :1] + 0.1 * breaths.u_in)
    assert load_simulators("my_simulators:one").lungs == LUNGS
    assert load_simulators("my_simulators:by_lung").lungs == (Lung(5.0, 10.0),)
    for name, problem in (("number", "a int is neither"), ("gone", "AttributeError")):
        with pytest.raises(InputError, match=problem):
            load_simulators(f"my_simulators:{name}")
    with pytest.raises(InputError, match="no_such_module"):
        load_simulators("no_such_module:f")
    assert sys.path == before


def test_simulated_pressures_from_a_table_or_an_array(breaths, tmp_path):
    simulated = load_simulators("physics").pressures(breaths)
    path = tmp_path / "simulated.csv"
    write(dataclasses.replace(breaths, pressure=simulated), path)
    for found in (load_simulators(path), load_simulators(simulated, breaths=breaths)):
        assert (type(found), found.has_plants, found.lungs) == (SimulatedPressures, False, ())
        np.testing.assert_allclose(found.pressures(breaths), simulated, atol=1e-5)
        some = breaths.select([2, 0])
        np.testing.assert_allclose(found.pressures(some), simulated[[2, 0]], atol=1e-5)
        with pytest.raises(InputError, match="simulated pressures of recorded breaths, not a sim"):
            _ = found.stacked
        with pytest.raises(InputError, match="closed loop"):
            found.respond("R20C50", *np.zeros((3, 4)), initial_pressure=5.0)
        other = dataclasses.replace(breaths, breath_id=breaths.breath_id + 100)
        with pytest.raises(InputError, match="has no breath 10"):
            found.pressures(other)
        with pytest.raises(InputError, match="another command than the recording"):
            found.pressures(dataclasses.replace(breaths, u_in=breaths.u_in + 1.0))
        with pytest.raises(InputError, match=r"of R 20, in the recording of lung R5C50"):
            found.pressures(dataclasses.replace(breaths, R=np.full(3, 5.0)))
    with pytest.raises(InputError, match="needs the breaths it answers to"):
        load_simulators(simulated)
    blank = load_simulators(np.full_like(simulated, np.nan), breaths=breaths)
    with pytest.raises(InputError, match="blank or infinite simulated"):
        blank.pressures(breaths)


@pytest.mark.parametrize("given", ["magic", "no/such/file.json", "a b:c", 3 + 0j, object()])
def test_what_stands_for_nothing_is_refused(given):
    refused = r"choose frozen|stands for no simulators|give a name, a file"
    with pytest.raises(InputError, match=refused):
        load_simulators(given)


def test_machine_code_of_others_is_refused_with_the_way_to_run_it(tmp_path):
    (path := tmp_path / "lung.FMU").write_bytes(b"PK")
    with pytest.raises(
        InputError, match=r"lung\.FMU is an FMU.*--simulator module:name.*own_rig\.md"
    ):
        load_simulators(path)


def test_learned_simulators_know_what_they_have_seen(breaths):
    found = load_simulators("frozen")
    assert isinstance(found, FrozenSimulators)
    assert found.trained.held_out(breaths).all()  # new breaths
    assert found.trained.unseen(breaths).all()
