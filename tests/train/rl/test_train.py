"""The commands `train ppo` and `train dqn`."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from ventbench.base.errors import InputError
from ventbench.cli import app
from ventbench.task.lungs import LUNG_IDS
from ventbench.train.plants import NETWORKS
from ventbench.train.rl import environment
from ventbench.train.rl.train import METHODS, _groups, method_for


def run(*arguments: object):
    return CliRunner().invoke(app, [str(one) for one in arguments])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--lung", "R20C50", "--all"], "not both"),
        (["--lung", "R20C51"], "not a scored lung"),
        (["--lung", "R20C50", "--steps", "100"], "less than one iteration of ppo, 96 breaths"),
    ],
)
def test_what_cannot_be_trained(arguments, said, tmp_path):
    found = run("train", "ppo", *arguments, "--out", tmp_path).exception
    assert isinstance(found, InputError)
    assert said in str(found)
    assert not list(tmp_path.iterdir())


def test_networks_of_one_lung_and_of_all_are_trained_apart():
    one, everything = _groups(NETWORKS, 6)
    assert (one.names, one.lungs) == (LUNG_IDS, 1)
    assert (everything.names, everything.lungs) == (("all",), 6)
    assert _groups(["R5C10"], 6) == [_groups(["R5C10", "all"], 6)[0]]


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("lungs", [1, 6])
def test_published_settings_fit_their_lungs(name, lungs):
    found = method_for(name, lungs)
    assert found.breaths % lungs == 0
    steps = found.breaths * environment.MOVES * 7
    assert method_for(name, lungs, steps + 10).iterations == 7


@pytest.mark.slow
@pytest.mark.parametrize(("method", "steps"), [("ppo", 32_000), ("dqn", 40_000)])
def test_train(method, steps, tmp_path):
    arguments = ("--lung", "R20C50", "--steps", steps, "--out", tmp_path, "--json", "-")
    result = run("train", method, *arguments)
    assert result.exit_code == 0, result.output
    about = json.loads((tmp_path / "training.json").read_text())
    # As `ventbench.score` has it of this PID on the reference rig.
    assert about["networks"]["R20C50"]["error_pid"] == pytest.approx(3.443, abs=2e-3)
    seeds = [f"weights-{seed}.npz" for seed in range(2)]
    assert {path.name for path in tmp_path.iterdir()} == {"training.json", "weights.npz", *seeds}
    best = about["networks"]["R20C50"]["seed"]
    written = (tmp_path / "weights.npz").read_bytes()
    assert [(tmp_path / name).read_bytes() == written for name in seeds] == [
        seed == best for seed in range(2)
    ]
    with np.load(tmp_path / "weights.npz") as arrays:
        assert set(arrays) == {f"R20C50.{kind}{k}" for kind in "wb" for k in range(3)}
