"""Patient effort, whose likelihood has many peaks in each breath."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis.evaluator import Evaluator, fit_with_noise
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis
from ventbench.diagnosis.patient_effort import (
    AMPLITUDE,
    DURATION,
    ONSET,
    BreathTerm,
    PatientEffortTerm,
    breath_term,
)
from ventbench.system_id import Noise

from . import small

EFFORT = Hypothesis(("patient_effort",))
TERM = PatientEffortTerm()
NOISE = Noise((0.1,), (0.0,), np.inf)


@pytest.fixture(scope="module")
def active() -> Evaluator:
    one = small.effect("patient_effort", amplitude=5.0, duration=0.6)
    return small.split(small.made(one, noise=0.1))


@pytest.fixture(scope="module")
def fitted(active) -> FittedModel:
    return fit_with_noise(active, EFFORT)


def misplaced(fitted: FittedModel, onset: float) -> np.ndarray:
    """The unknowns of a model with all efforts at another onset, s."""
    x = fitted.minimum.x.copy()
    x[fitted.problem.unknowns.of(ONSET)] = onset
    return x


def test_all_efforts_are_found_from_a_poor_start(active, fitted):
    assert np.std(fitted.residual) == pytest.approx(0.1, rel=0.2)
    assert fitted.column(DURATION)[0] == pytest.approx(0.6, rel=0.05)
    strong = np.abs(fitted.column(AMPLITUDE)) > 2.0
    assert strong.any()
    assert not strong.all()


@pytest.mark.parametrize("refit", [False, True])
def test_misplaced_efforts_are_moved_back(fitted, refit):
    problem = fitted.problem
    wrong = misplaced(fitted, 1.7)
    mended = TERM.start(problem, wrong, EFFORT.names if refit else (), refit=refit)
    gained = problem.log_likelihood(mended) - problem.log_likelihood(wrong)
    strong = np.abs(fitted.column(AMPLITUDE)) > 2.0
    assert np.all(gained[strong] > 100.0)
    assert np.all(gained >= 0.0)
    assert np.array_equal(wrong, misplaced(fitted, 1.7))


def test_efforts_that_are_the_likeliest_stay(fitted):
    x = fitted.minimum.x
    assert TERM.start(fitted.problem, x, (), refit=False) == pytest.approx(x)


def test_the_gain_of_a_breath_is_the_integral_over_its_efforts(active, fitted):
    """Against a sum over a fine grid of amplitudes and onsets, at the fitted parameters."""
    still, x = active.refit_breath_parameters(fitted)
    still = dataclasses.replace(still, noise=NOISE)
    found = TERM.log_likelihood_gain(still, x, fitted)
    names = still.predictor.names
    columns = [names.index(path) for path in (AMPLITUDE, ONSET)]
    amplitudes, onsets = np.arange(-8.0, 8.01, 0.25), np.arange(0.0, 1.7, 0.04)
    total = np.full(len(found), -np.inf)
    for amplitude in amplitudes:
        for onset in onsets:
            values = still.values(x)
            values[:, columns] = amplitude, onset
            residual = still.residual_of(values)
            likelihood = NOISE.log_likelihood(residual, still.data.weight)
            total = np.logaddexp(total, likelihood - 0.5 * (amplitude / 3.0) ** 2)
    total += np.log(0.25 / (np.sqrt(2.0 * np.pi) * 3.0) * 0.04 / 1.7)
    quiet = still.log_likelihood(x)
    exact = np.logaddexp(np.log(0.4), np.log(0.6) + total - quiet)
    clear = exact > 20.0
    assert clear.any()
    # Starts are fitted as well, but not in the sum; a large effort is between points of the grid.
    assert found[clear] == pytest.approx(exact[clear], rel=0.1, abs=6.0)
    assert np.all(found[~clear] < 20.0)


def test_training_and_held_out_breaths_are_integrated_alike(active, fitted):
    training = dataclasses.replace(active, held_out=active.training)
    held_out = training.held_out_log_likelihood(fitted)
    marginal = TERM.marginal_log_likelihood(fitted)
    assert marginal == pytest.approx(held_out, abs=4.0)


def test_the_prediction_is_the_mean_over_efforts_with_their_spread(active, fitted):
    passive = active.fit(Hypothesis(), fitted.noise, fitted)
    values = active.transferred_values(fitted, active.held_out)
    simulator = active.held_out.predictor
    columns = [simulator.names.index(path) for path in (AMPLITUDE, ONSET)]
    answers = []
    for effort in zip(fitted.column(AMPLITUDE), fitted.column(ONSET), strict=True):
        values[:, columns] = effort
        answers.append(simulator.predict(values))
    expected = active.predict(fitted, active.held_out)
    assert expected == pytest.approx(np.mean(answers, axis=0))
    spread = TERM.spread(fitted, simulator, values.copy())
    np.testing.assert_allclose(spread, np.std(answers, axis=0), atol=1e-6)
    assert np.abs(expected - active.predict(passive, active.held_out)).max() > 0.2


def test_only_a_hypothesis_with_effort_has_a_breath_term(active, fitted):
    assert isinstance(active.breath_term(fitted), PatientEffortTerm)
    assert type(breath_term(("leak",))) is BreathTerm


def test_a_warm_start_with_efforts_is_left_alone_unless_it_is_refitted(fitted):
    x = misplaced(fitted, 1.7)
    assert TERM.start(fitted.problem, x, EFFORT.names, refit=False) is x
