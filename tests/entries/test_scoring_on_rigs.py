"""Airway pressure on rigs, step by step and in a compiled scan alike."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.controllers.pid import PID
from ventbench.entries.cells import InProcessRunner, protocol_of
from ventbench.entries.folder import open_submission, submission_of
from ventbench.entries.scoring import run_protocol
from ventbench.plants import frozen
from ventbench.plants.rigs import load_rigs, rigs_of
from ventbench.task import environment, rollouts
from ventbench.task.metrics.score import run_error

from ..textbook_rigs import OFFSET, TextbookRigs
from ..valve import Lowered, Stepped

PIPS = (10.0, 35.0)

#: Gains of the submission, %/cmH2O.
PID_ROBUST = (4.0, 8.0, 9.0)


@pytest.fixture(scope="module")
def rigs():
    return TextbookRigs().scored()


@pytest.fixture(scope="module")
def result(rigs):
    return run_protocol(
        open_submission("pid_robust"),
        protocol_of(rigs, draws=4, pips=PIPS),
        runner=InProcessRunner(),
    )


def compiled(rigs, draws):
    """Errors and requested commands of the same PID in one scan."""
    with compilation.float64():
        plants, cells = rigs.cells(rigs.draws(draws, PIPS), PIPS)
        plants, cells = jax.tree.map(jax.numpy.asarray, (plants, cells))

        def run(plant, cell):
            return rollouts.closed_loop(plant, Stepped(Lowered(PID(*PID_ROBUST))), cell)[0]

        inspired = jax.tree.map(np.asarray, jax.vmap(run)(plants, cells))
    return run_error(inspired.pressure, np.asarray(cells.pip)[..., None, None]), inspired


def test_equals_a_compiled_scan(rigs, result):
    errors, inspired = compiled(rigs, 4)
    np.testing.assert_allclose(result.nominal, errors[:, 0], atol=1e-9)
    np.testing.assert_allclose(result.drawn, np.moveaxis(errors[:, 1:], 1, 0), atol=1e-9)
    applied = environment.resolved(result.requested)  # a submission may ask for more
    np.testing.assert_allclose(applied, inspired.requested, atol=1e-9)


def test_scores_the_airway_and_shows_the_reading(rigs):
    seen = []

    def watch(observation):
        seen.append(observation.pressure)
        return 0.0

    quiet = run_protocol(submission_of(watch), protocol_of(rigs, pips=(10.0,)))
    # The valve stays closed: the airway stays at PEEP, the sensor shows more.
    np.testing.assert_allclose(quiet.nominal, 5.0)
    assert max(seen) == pytest.approx(5.0 + OFFSET)


def test_draws_run_on_the_rigs_that_they_name(rigs, result):
    drawn = result.rig_draws
    assert sorted(set(drawn.rig[0])) == [0, 1]
    # The second rig of a lung is another plant: the same deviations on the first give other errors.
    first = np.zeros_like(drawn.rig) + np.array([own[0] for own in rigs.sessions])[:, None]
    forced = dataclasses.replace(drawn, rig=first, member=np.zeros_like(drawn.member))
    again = run_protocol(
        open_submission("pid_robust"),
        protocol_of(rigs, drawn=forced, pips=PIPS),
        runner=InProcessRunner(),
    )
    changed = np.any(again.drawn != result.drawn, axis=2).T
    elsewhere = (drawn.rig != forced.rig) | (drawn.member > 0)
    np.testing.assert_array_equal(changed, elsewhere)


def test_json_says_which_draws(rigs, result):
    value = json.loads(json.dumps(result.to_json()))
    assert value["draws"]["season"] == "development"
    assert value["draws"]["sha256"] == rigs.draws(2).commitment
    low, high = value["draws"]["ci95"]
    assert low < value["draws"]["score"] < high
    assert value["simulators"]["version"] == 2
    assert value["official"] is False


def test_trajectories_are_those_of_the_nominal_cells(result):
    np.testing.assert_allclose(result.trajectories.errors().to_numpy(), result.nominal, atol=1e-9)


def test_simulators_with_one_rig_can_be_scored():
    answer = run_protocol(
        submission_of(lambda o: 4.0), protocol_of(load_rigs("physics"), draws=1, pips=(10.0,))
    )
    assert answer.nominal.shape == (6, 1)
    assert answer.rig_draws is not None
    assert not answer.rig_draws.rig.any()
    assert not answer.official


@pytest.mark.slow
def test_the_frozen_rigs_can_be_scored():
    official = rigs_of(frozen.load())
    result = run_protocol(
        open_submission("pid_robust"),
        protocol_of(official, draws=2, pips=PIPS),
        runner=InProcessRunner(),
    )
    errors, _ = compiled(official, 2)
    np.testing.assert_allclose(result.drawn, np.moveaxis(errors[:, 1:], 1, 0), atol=1e-9)
