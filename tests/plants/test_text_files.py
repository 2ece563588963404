"""Plants as JSON: back to the bit, refused by name, stacked over lungs, scored."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench import files as whole_files
from ventbench import precision
from ventbench.cli import app
from ventbench.errors import InputError
from ventbench.lungs import LUNGS, lung
from ventbench.physics import physics
from ventbench.plants import alike, frozen, text_files
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stack import take
from ventbench.rollouts import open_loop


def late(lung_id: str, **base: float):
    with precision.float64():
        return physics(lung(lung_id), {"valve_delay": {"delay": 1.0 / 24.0}}, **base)


@pytest.mark.parametrize("kind", ["physics", "frozen"])
def test_back_to_the_bit(kind: str, tmp_path: Path) -> None:
    plants = {"R20C50": late("R20C50"), "R33C7.5": late("R33C7.5", R_ex=6.1)}
    if kind == "frozen":
        plants = {item.id: take(frozen.load().plants, i) for i, item in enumerate(LUNGS[:2])}
    path = tmp_path / "corrected.json"
    text_files.save(path, plants, {"recording": None})
    found = text_files.load(path)
    assert list(found) == list(plants)
    for name, plant in plants.items():
        assert jax.tree.structure(found[name]) == jax.tree.structure(plant)
        leaves, wanted = jax.tree.leaves(found[name]), jax.tree.leaves(plant)
        for leaf, want in zip(leaves, wanted, strict=True):
            assert leaf.dtype == np.asarray(want).dtype
            np.testing.assert_array_equal(leaf, want)
    text_files.save(tmp_path / "again.json", plants, {"recording": None})
    assert whole_files.sha256(path) == whole_files.sha256(tmp_path / "again.json")
    assert json.loads(path.read_text())["about"] == {"recording": None}


def test_what_is_no_file_of_plants_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "corrected.json"
    text_files.save(path, {"R20C50": late("R20C50")})
    good = json.loads(path.read_text())
    unknown = json.loads(json.dumps(good).replace('"Physics"', '"Popen"'))
    dtype = json.loads(json.dumps(good).replace('"float64"', '"object"', 1))
    label = {**good, "lungs": {"big": good["lungs"]["R20C50"]}}
    for text in (
        "", "[]", "{}", json.dumps({**good, "format": "x"}), json.dumps({**good, "lungs": {}}),
        json.dumps(unknown), json.dumps(dtype), json.dumps(label),
        json.dumps({**good, "arrays": {}}),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(InputError, match=r"corrected\.json is not a file of plants"):
            text_files.load(path)


def test_a_parameter_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        text_files.save(tmp_path / "x.json", {"R20C50": late("R20C50", gain=np.nan)})
    assert not list(tmp_path.iterdir())


def test_physics_with_other_mechanisms_are_stacked_and_stay_themselves() -> None:
    with precision.float64():
        leaking = physics(lung("R5C10"), {"leak": {"conductance": 8.0}})
        both = alike.stacked([late("R20C50"), leaking])
        u_in = np.array([[30.0, 20.0, 0.0, 10.0, 0.0, 0.0]])
        u_out, dt = np.array([[0.0, 0.0, 0.0, 0.0, 1.0, 1.0]]), np.full((1, 6), 0.03)
        commands = [jnp.asarray(x) for x in (np.array([5.0]), u_in, u_out, dt)]
        for index, plant in enumerate((late("R20C50"), leaking)):
            answer = open_loop(plant, *commands)
            assert np.ptp(answer) > 5.0
            found = open_loop(take(both, index), *commands)
            np.testing.assert_allclose(found, answer, rtol=1e-9)


def test_plants_that_cannot_be_stacked() -> None:
    with pytest.raises(InputError, match="make a file for each lung"):
        alike.stacked([late("R20C50"), single_compartment(lung("R5C10"))])
    with pytest.raises(InputError, match="PEEP of their own"):
        alike.stacked([late("R20C50"), late("R5C10", PEEP=5.0)])


def run(*arguments: object) -> tuple[int, str]:
    found = CliRunner().invoke(app, [*map(str, arguments)])
    if isinstance(found.exception, InputError):  # main() prints it and exits with 2
        return 2, str(found.exception)
    return found.exit_code, found.stdout


def test_score_on_the_plants_of_a_file(tmp_path: Path) -> None:
    """Its lungs are those of the file, and the score is that of the same plants elsewhere."""
    from ventbench.submissions.folder import open_submission
    from ventbench.submissions.scoring import run_protocol

    plants = {name: single_compartment(lung(name)) for name in ("R20C20", "R5C10")}
    path = tmp_path / "corrected.json"
    text_files.save(path, plants)
    options = ("score", "pid_best", "--plant", path, "--in-process")
    code, text = run(*options, "--json", "-")
    plain = json.loads(text)
    assert code == 0
    assert list(plain["lungs"]) == ["R20C20", "R5C10"]
    assert plain["official"] is False
    assert plain["simulators"]["sha256"] == whole_files.sha256(path)
    wanted = run_protocol(
        open_submission("pid_best"),
        alike.stacked(list(plants.values())),
        lungs=[lung(name) for name in plants],
    )
    assert plain["score"] == pytest.approx(wanted.score, abs=1e-12)
    code, text = run(*options)
    assert code == 0
    assert "R20C20" in text
    assert "R5C20" not in text
    code, text = run(*options, "--draws", 20, "--record", tmp_path / "records")
    assert code == 2
    assert "leave --plant out" in text
    assert run("score", "pid_best", "--plant", "nothing")[0] == 2
