"""Latent inputs: their response, and whether they are found and told from noise."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import integrate

from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.gaussian_process import Kernel, LinearBreaths, components
from ventbench.diagnosis.hypothesis import Hypothesis
from ventbench.diagnosis.latent_inputs import (
    ALVEOLUS,
    GAIN_SCATTER,
    MEASUREMENT,
    SUPPLY,
    at_best_noise,
    fit_latent_inputs,
    input_responses,
    log_likelihood_without_input,
    place_weights,
)
from ventbench.diagnosis.selection.candidate_comparison import fit_with_noise
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
    # A sine of amplitude 1.3, and nothing but white noise of 0.2 beside it.
    assert best.size == pytest.approx(1.3 / np.sqrt(2), rel=0.2)
    assert best.noise.sigma[0] == pytest.approx(0.2, rel=0.1)
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
    assert best.size == pytest.approx(0.175 / np.sqrt(2), rel=0.2)


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


def without_patience(evaluator: Evaluator) -> Evaluator:
    """The evaluator with starts of breaths that are fitted to the end."""
    fits = dataclasses.replace(evaluator.settings.fit, breath_tolerance=1e-12, breath_iterations=30)
    settings = dataclasses.replace(evaluator.settings, fit=fits)
    return dataclasses.replace(evaluator, settings=settings)


def test_without_an_input_the_likelihood_is_that_of_the_names(plain):
    evaluator = without_patience(plain.evaluator)
    model = at_best_noise(evaluator, plain.base)
    _, held_out = log_likelihood_without_input(evaluator, plain.base)
    problem, x = evaluator.refit_breath_parameters(model)
    names = evaluator.held_out_log_likelihood(model)
    np.testing.assert_allclose(held_out, names, rtol=0, atol=1e-9)
    whitened = LinearBreaths.of(problem, x).whitened(model.noise)
    np.testing.assert_allclose(whitened.marginal(1.0).nats, names, rtol=0, atol=1e-9)
    np.testing.assert_allclose(problem.log_likelihood(x), names, rtol=0, atol=1e-9)


def test_the_noise_without_an_input_is_the_likeliest(plain):
    evaluator = plain.evaluator
    # A noise far off is climbed to the same place.
    off = dataclasses.replace(plain.base.noise, sigma=(0.5,), ar=(0.6,))
    start = dataclasses.replace(
        plain.base, problem=dataclasses.replace(plain.base.problem, noise=off)
    )
    best = at_best_noise(evaluator, plain.base)
    again = at_best_noise(evaluator, start)
    top = evaluator.training_log_likelihood(best)
    assert evaluator.training_log_likelihood(again) == pytest.approx(top, abs=0.5)
    assert best.noise.sigma[0] == pytest.approx(0.2, rel=0.1)
    for sigma, ar in ((0.9, 0.0), (1.1, 0.0), (1.0, -0.1), (1.0, 0.1)):
        other = dataclasses.replace(
            best.noise, sigma=(sigma * best.noise.sigma[0],), ar=(ar + best.noise.ar[0],)
        )
        assert evaluator.training_log_likelihood(best, other) < top


def training_likelihood(evaluator, found, noise, size):
    """Log marginal likelihood of the training breaths at another noise and size, nats."""
    problem, x = evaluator.refit_breath_parameters(found.beside, evaluator.training)
    responses = input_responses(evaluator.training, problem.values(x), found.place)
    kernel = Kernel(found.periodic, found.scale)
    parts = components(evaluator.training.data.dt, kernel, 1e-2)
    whitened = LinearBreaths.of(problem, x).whitened(noise, np.matmul(parts, responses)[:, :, None])
    return float(whitened.marginal(size).nats.sum())


@pytest.mark.parametrize("place", [ALVEOLUS, MEASUREMENT])
def test_size_and_noise_are_climbed_to_the_top(place):
    effect = small.effect("cardiogenic", "oscillation", amplitude=1.3, frequency=1.4)
    evaluator, base, (training, _) = latent_input_recording(effect, style="pi")
    found = fit_latent_inputs(evaluator, base, (place,))[place]
    sigma, ar = found.noise.sigma[0], found.noise.ar[0]

    def at(sigma: float, ar: float, size: float) -> float:
        noise = dataclasses.replace(found.noise, sigma=(sigma,), ar=(ar,))
        return training_likelihood(evaluator, found, noise, size)

    top = at(sigma, ar, found.size)
    assert top == pytest.approx(found.training_log_likelihood, abs=0.1)
    assert top > training
    for factor in (0.8, 0.95, 1.05, 1.25):
        assert at(factor * sigma, ar, found.size) < top + 0.3
        assert at(sigma, ar, factor * found.size) < top + 0.3
        assert at(sigma, np.tanh(np.arctanh(ar) + factor - 1.0), found.size) < top + 0.3
    if place == ALVEOLUS:
        # The true place leaves the true noise.
        assert sigma == pytest.approx(0.2, rel=0.1)
        assert ar == pytest.approx(0.0, abs=0.15)


def test_wild_readings_change_neither_place_nor_size():
    effect = small.effect("cardiogenic", "oscillation", amplitude=1.3, frequency=1.4)
    breaths = small.made(effect)
    pressure = breaths.pressure.copy()
    pressure[::4, 20] += 15.0  # in half of the training breaths
    wild = dataclasses.replace(breaths, pressure=pressure)
    best = []
    for recording in (breaths, wild):
        evaluator = small.split(recording)
        found = fit_latent_inputs(evaluator, fit_with_noise(evaluator, Hypothesis()))
        best.append(max(found.values(), key=lambda latent: latent.training_log_likelihood))
    assert [latent.place for latent in best] == [ALVEOLUS, ALVEOLUS]
    assert best[1].scale == pytest.approx(best[0].scale, abs=0.15)
    assert best[1].size == pytest.approx(best[0].size, rel=0.15)
