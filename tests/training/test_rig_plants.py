"""What controllers of protocol version 2 are trained on, and the best PIDs there."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
import pytest

from ventbench import draws
from ventbench.errors import InputError
from ventbench.lungs import LUNG_IDS
from ventbench.plants import frozen
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.rigs import load_rigs
from ventbench.submissions.folder import submission_of
from ventbench.submissions.scoring import run_protocol
from ventbench.training import rig_pid
from ventbench.training.rig_plants import plants_to_train_on

PIDS = np.array([(2.0, 4.0, 0.0), (5.0, 5.0, 0.0), (0.0, 0.1, 0.0)])


def _hybrid(plants: Any) -> Hybrid:
    assert isinstance(plants, Hybrid)
    return plants


@pytest.fixture(scope="module")
def official():
    return frozen.load(version=2)


def test_every_member_of_every_training_rig_is_there_and_no_held_out_one(official):
    given = plants_to_train_on(version=2)
    assert given.names == LUNG_IDS
    members, plants, first = official.sessions_plants, _hybrid(given.plants), _hybrid(given.nominal)
    for lung, (rigs, apart) in enumerate(
        zip(official.training_rigs, official.held_out_rigs, strict=True)
    ):
        assert apart not in rigs
        trained = {tuple(row) for row in np.stack([plants.E, plants.R], -1)[:, lung]}
        wanted = {
            tuple(row) for row in np.stack([members.E, members.R], -1)[:, rigs].reshape(-1, 2)
        }
        assert trained == wanted
        nominal = members.E[0, official.rigs[lung][0]]
        assert plants.E[0, lung] == first.E[lung] == nominal


def test_a_cell_weighs_what_the_normalised_score_divides_by():
    weights = plants_to_train_on(version=2).weights
    assert weights.shape == (6, 6)
    assert weights.mean() == pytest.approx(1.0)
    # At PIP 10 on a stiff lung little is to be gained, at PIP 35 on R20C50 much.
    assert weights[0, 0] > 3 * weights[5, 5] > 0


def test_version_1_and_other_simulators_have_one_plant_a_lung_or_their_ensemble():
    assert _hybrid(plants_to_train_on().plants).R.shape == (5, 6)
    own = plants_to_train_on("single_compartment", version=2)
    assert jax.tree.leaves(own.plants)[0].shape == (1, 6)
    assert np.all(own.weights == 1.0)
    with pytest.raises(InputError, match="protocol 3"):
        plants_to_train_on(version=3)


@pytest.mark.slow
def test_gains_are_tuned_on_draws_of_their_own(official, monkeypatch):
    told = []
    tuned = rig_pid.tune_on_rigs(gains=PIDS, draws=2, progress=lambda *x: told.append(x))
    assert told[-1] == (6, 6)
    assert tuned.lungs == LUNG_IDS
    assert {tuple(gains) for gains in tuned.gains} <= {tuple(gains) for gains in PIDS[:2]}
    assert tuple(tuned.single) == tuple(PIDS[1]) or tuple(tuned.single) == tuple(PIDS[0])
    result = tuned.to_json()
    assert result["lungs"]["R5C10"]["error"] == pytest.approx(tuned.errors[0])
    assert result["simulators"]["manifest_sha256"] == official.manifest_sha256
    assert rig_pid.TUNING_SEED != draws.DEVELOPMENT_SEED

    asked = []

    @contextmanager
    def cluster(*where):
        asked.append(where)
        with ThreadPoolExecutor(2) as pool:
            yield pool

    monkeypatch.setattr(rig_pid, "executor", cluster)
    again = rig_pid.tune_on_rigs(gains=PIDS, draws=2, scheduler="tcp://elsewhere:8786")
    assert asked == [(0, "tcp://elsewhere:8786")]
    assert again.to_json() == result


@pytest.mark.slow
def test_an_error_on_draws_is_that_of_the_scorer():
    rigs = load_rigs("single_compartment")
    drawn = draws.build(tuple((0,) for _ in rigs.lungs), 1, seed=rig_pid.TUNING_SEED, n=1)
    found = rig_pid.drawn_errors(rigs, drawn, 2, PIDS[:1])

    class Controller:
        def reset(self, task):
            self.integral = self.before = self.derivative = 0.0

        def act(self, observation):
            if observation.time == 0:
                self.reset(None)
            error = observation.target - observation.pressure
            a = observation.dt / (observation.dt + 0.5)
            self.integral += a * (error - self.integral)
            return 2.0 * error + 4.0 * self.integral

    score = run_protocol(submission_of(Controller), rigs, drawn=drawn)
    assert score.controllable is not None
    np.testing.assert_allclose(found[0], score.controllable[2, 1], atol=1e-9)
