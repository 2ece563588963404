"""Latent inputs: their response, and whether they are found and told from noise."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import integrate

from ventbench.diagnosis.candidate_comparison import fit_with_noise
from ventbench.diagnosis.hypothesis import Hypothesis, Partition
from ventbench.diagnosis.latent_inputs import (
    ALVEOLUS,
    GAIN_SCATTER,
    MEASUREMENT,
    SUPPLY,
    _GaussianProcess,
    _Kernel,
    fit_latent_inputs,
    input_responses,
    log_likelihood_without_input,
    place_weights,
)
from ventbench.diagnosis.linearisation import linearise
from ventbench.system_id import Predictor

from . import small

INSPIRED = 30


def likelihoods(**nats: float | list[float]) -> list[Any]:
    """Inputs by their held-out log-likelihoods in ten breaths."""
    return [
        SimpleNamespace(place=place, held_out_log_likelihood=np.broadcast_to(gains, 10))
        for place, gains in nats.items()
    ]


def test_weights_of_places_are_those_of_a_bayesian_bootstrap():
    """The share of one breath among ten is distributed as Beta(1, 9)."""
    ahead = 2.0
    gains = [ahead, *[0.0] * 9]
    weights = place_weights(likelihoods(supply=0.0, alveolus=gains))
    expected, _ = integrate.quad(
        lambda share: 9.0 * (1.0 - share) ** 8 / (1.0 + np.exp(-10.0 * share * ahead)), 0.0, 1.0
    )
    assert list(weights) == ["alveolus", "supply"]
    assert weights["alveolus"] == pytest.approx(expected, abs=0.01)
    assert sum(weights.values()) == pytest.approx(1.0)


def test_a_place_that_one_breath_alone_prefers_is_not_certain():
    every = place_weights(likelihoods(supply=3.0, alveolus=0.0))
    one = place_weights(likelihoods(supply=[39.0, *[-1.0] * 9], alveolus=0.0))
    assert every["supply"] > 0.999
    assert one["supply"] < 0.9
    assert place_weights(likelihoods(a=1.0, b=1.0, c=1.0))["b"] == pytest.approx(1.0 / 3.0)


@pytest.fixture(scope="module")
def clean(plain):
    """The training breaths, the values of a fit to them, and its prediction, ``(n, T)``."""
    partition = plain.evaluator.training
    values = plain.evaluator.transferred_values(plain.base, partition)
    return partition, values, partition.predictor.predict(values)[:, 0]


def test_an_input_at_the_alveolus_acts_as_muscles_do(clean):
    partition, values, before = clean
    names = partition.predictor.names
    time = np.cumsum(partition.data.dt, axis=1) - partition.data.dt
    onset, duration, amplitude = 0.5, 0.7, -0.5
    pulling = values.copy()
    for name, value in (("amplitude", amplitude), ("onset", onset), ("duration", duration)):
        pulling[:, names.index(f"patient_effort.{name}")] = value
    seen = partition.predictor.predict(pulling)[:, 0] - before
    source = -amplitude * np.sin(np.pi * np.clip((time - onset) / duration, 0.0, 1.0))
    answer = input_responses(partition, values, ALVEOLUS)
    drawn = np.einsum("nk,nkt->nt", source, answer)
    # In inspiration the valve sets the flow, so that the input adds to the pressure as it is.
    np.testing.assert_allclose(drawn[:, :INSPIRED], source[:, :INSPIRED], atol=1e-9)
    np.testing.assert_allclose(seen[:, :INSPIRED], source[:, :INSPIRED], atol=1e-6)
    assert np.abs(seen[:, INSPIRED + 2 :]).max() > 0.02
    np.testing.assert_allclose(drawn, seen, atol=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("sample", [5, 17, 29])
def test_an_input_at_the_supply_acts_as_more_command(clean, sample):
    partition, values, before = clean
    u_in = partition.data.u_in.copy()
    u_in[:, sample - 1] *= 1.001
    other = Predictor(dataclasses.replace(partition.data, u_in=u_in), partition.predictor.names)
    slope = (other.predict(values)[:, 0] - before) / 0.001
    found = input_responses(partition, values, SUPPLY)[:, sample]
    np.testing.assert_allclose(found[:, :INSPIRED], slope[:, :INSPIRED], atol=1e-3)
    assert np.abs(slope).max() > 1.0
    np.testing.assert_allclose(found, slope, atol=0.1 * np.abs(slope).max())


def test_gain_scatter_scales_all_commands(clean):
    partition, values, before = clean
    column = partition.predictor.names.index("gain")
    more = values.copy()
    more[:, column] *= 1.0001
    slope = (partition.predictor.predict(more)[:, 0] - before) / 0.0001
    found = input_responses(partition, values, GAIN_SCATTER)
    assert found.shape == (8, 1, small.SAMPLES)
    np.testing.assert_allclose(found[:, 0], slope, atol=1e-3 * np.abs(slope).max())


def test_an_input_at_the_sensor_is_added_to_the_reading(clean):
    partition, values, _ = clean
    found = input_responses(partition, values, MEASUREMENT)
    assert np.array_equal(found, np.broadcast_to(np.eye(small.SAMPLES), found.shape))


def latent_input_recording(*effects, seed=0, **changed):
    evaluator = small.split(small.made(*effects, seed=seed, **changed))
    base = fit_with_noise(evaluator, Hypothesis())
    return evaluator, base, log_likelihood_without_input(evaluator, base)


@pytest.mark.parametrize("frequency", [1.1, 1.5])
def test_a_beating_heart_is_found_at_its_rate(frequency):
    effect = small.effect("cardiogenic", "oscillation", amplitude=1.3, frequency=frequency)
    evaluator, base, (training, held_out) = latent_input_recording(effect, style="pi")
    found = fit_latent_inputs(evaluator, base)
    best = found[ALVEOLUS]
    assert best.periodic
    assert best.scale == pytest.approx(frequency, abs=0.2)
    # A sine of amplitude 1.3.
    assert best.size in (0.8, 1.6)
    assert best.training_log_likelihood > training + 40.0
    assert np.sum(best.held_out_log_likelihood - held_out) > 20.0
    # In the physics, not in the sensor: exhalation tells.
    assert best.training_log_likelihood > found[MEASUREMENT].training_log_likelihood
    assert best.course.shape == (8, small.SAMPLES)
    assert np.std(best.course[:, :INSPIRED]) == pytest.approx(1.3 / np.sqrt(2), rel=0.25)


def test_a_pulsating_supply_is_found_at_the_supply():
    effect = small.effect("pulsating_supply", "oscillation", amplitude=0.175, frequency=5.0)
    evaluator, base, _ = latent_input_recording(effect)
    found = fit_latent_inputs(evaluator, base)
    best = max(found.values(), key=lambda latent: latent.training_log_likelihood)
    assert best.place == SUPPLY
    assert best.periodic
    assert best.scale == pytest.approx(5.0, abs=0.26)
    assert 0.05 < best.size < 0.4


@pytest.mark.parametrize("coloured", [0.0, 0.6])
def test_noise_is_no_input_in_the_physics(coloured):
    evaluator, base, (_, held_out) = latent_input_recording(
        coloured=coloured, correlation=0.8, seed=7
    )
    found = fit_latent_inputs(evaluator, base)
    sensor = found.pop(MEASUREMENT)
    best = max(found.values(), key=lambda latent: latent.training_log_likelihood)
    gained = float((best.held_out_log_likelihood - held_out).sum())
    ahead = float((best.held_out_log_likelihood - sensor.held_out_log_likelihood).sum())
    assert min(gained, ahead) < 4.6


def test_the_likelihood_without_an_input_is_that_of_the_breaths(plain):
    noise = dataclasses.replace(plain.base.noise, tail=np.inf)
    base = plain.evaluator.fit(Hypothesis(), noise, plain.base)
    _, held_out = log_likelihood_without_input(plain.evaluator, base)
    constant = 0.5 * np.log(2 * np.pi) * small.SAMPLES
    np.testing.assert_allclose(
        held_out - constant, plain.evaluator.held_out_log_likelihood(base), atol=0.2
    )


def test_the_gain_of_an_input_is_the_ratio_of_two_gaussians(plain):
    """Against the determinant and the inverse of the whole covariance of a breath."""
    noise = dataclasses.replace(plain.base.noise, ar=(0.4,), tail=np.inf)
    problem, x = plain.evaluator.refit_breath_parameters(plain.base)
    place = linearise(
        dataclasses.replace(problem, noise=noise), x, small.SETTINGS.screening, clip=np.inf
    )
    partition: Partition = plain.evaluator.held_out
    answers = input_responses(partition, place.values, MEASUREMENT)
    settings = small.SETTINGS.latent_inputs
    kernel = _Kernel(True, 1.3, 0.7)
    gained = _GaussianProcess(place, partition, answers, kernel, settings).gained()
    time = np.cumsum(partition.data.dt, axis=1) - partition.data.dt
    own = place.own_basis.swapaxes(1, 2)
    for i in (0, 6):
        waves = np.stack([f(2 * np.pi * 1.3 * time[i]) for f in (np.cos, np.sin)])
        rows = waves.copy()
        rows[:, 1:] = (waves[:, 1:] - 0.4 * waves[:, :-1]) / np.sqrt(1 - 0.16)
        rows /= noise.sigma[0]
        rows = rows - rows @ own[i] @ own[i].T
        covariance = np.eye(small.SAMPLES) + 0.49 * rows.T @ rows
        r = place.residual[i]
        want = -0.5 * r @ np.linalg.solve(covariance, r) - 0.5 * np.linalg.slogdet(covariance)[1]
        assert gained[i] == pytest.approx(want + 0.5 * r @ r, abs=1e-6)
