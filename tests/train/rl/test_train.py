"""Networks of PPO and DQN, as the scripts of their entries train them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from submissions.dqn import train as dqn
from submissions.ppo import train as ppo
from ventbench.task.lungs import LUNG_IDS
from ventbench.train.rl import environment
from ventbench.train.rl import train as training
from ventbench.train.rl.train import TrainedPolicies, command, shortened

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


def test_networks_of_one_lung_and_of_all_are_trained_apart(monkeypatch, tmp_path):
    """Each network with each seed; what is kept is that of the lowest error on fresh cells."""
    given = []

    def train_none(method, lungs, seeds, **options):
        given.append((method.breaths, lungs.weights.shape[:2], list(seeds)))
        runs, zeros = len(seeds), np.zeros((len(seeds), 1), np.float32)
        error = np.arange(runs, 0, -1).astype(np.float32)
        numbers, seconds = np.arange(runs), np.zeros(1)
        return TrainedPolicies(numbers, error, numbers[:1], zeros, seconds, 0.0)

    monkeypatch.setattr(training, "train", train_none)
    monkeypatch.setattr(training, "_pid_errors", lambda lungs: [0.0] * len(lungs.weights))
    monkeypatch.setattr(training.residual, "save_policies", lambda path, policies: None)
    recipe = RECIPES["ppo"]
    found = training.train_networks(recipe, None, tmp_path, seeds=(3, 4), simulator="physics")
    assert given == [
        (recipe.per_lung.breaths, (12, 1), [3, 4] * 6),
        (recipe.every.breaths, (2, 6), [3, 4]),
    ]
    assert {name: int(x) for name, x in found.controllers.items()} == {  # type: ignore[call-overload]
        **{name: 2 * k + 1 for k, name in enumerate(LUNG_IDS)},
        "all": 1,
    }
    assert all(entry["seed"] == 4 for entry in found.report["networks"].values())


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
