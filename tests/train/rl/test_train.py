"""Networks of PPO and DQN, as the scripts of their entries train them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from submissions.dqn import train as dqn
from submissions.ppo import train as ppo
from ventbench.task.lungs import LUNG_IDS
from ventbench.train.plants import NETWORKS
from ventbench.train.rl import environment
from ventbench.train.rl.train import _groups, command, shortened

RECIPES = {"ppo": ppo.RECIPE, "dqn": dqn.RECIPE}


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Run the script of an entry."""

    def started(name: str, asked: str) -> None:
        monkeypatch.setattr("sys.argv", ["train.py", *asked.split(), "--out", str(tmp_path)])
        command(RECIPES[name], "")

    return started


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("--lung R20C50 --all", "not allowed with argument"),
        ("--lung R20C51", "not a scored lung"),
        ("--lung R20C50 --steps 100", "less than one iteration of ppo, 96 breaths"),
    ],
)
def test_what_cannot_be_trained(asked, said, run, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run("ppo", asked)
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_networks_of_one_lung_and_of_all_are_trained_apart():
    one, everything = _groups(NETWORKS, 6)
    assert (one.names, one.lungs) == (LUNG_IDS, 1)
    assert (everything.names, everything.lungs) == (("all",), 6)
    assert _groups(["R5C10"], 6) == [_groups(["R5C10", "all"], 6)[0]]


@pytest.mark.parametrize("name", RECIPES)
def test_published_settings_fit_their_lungs(name):
    recipe = RECIPES[name]
    for lungs, found in ((1, recipe.per_lung), (6, recipe.every)):
        assert found.breaths % lungs == 0
        steps = found.breaths * environment.MOVES * 7
        assert shortened(found, name, steps + 10).iterations == 7


@pytest.mark.slow
@pytest.mark.parametrize(("method", "steps"), [("ppo", 32_000), ("dqn", 40_000)])
def test_train(method, steps, run, tmp_path):
    run(method, f"--lung R20C50 --steps {steps}")
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
