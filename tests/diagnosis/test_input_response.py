"""Inputs that vary in time: their response, and whether they are found and told from noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ventbench.diagnosis.in_time import ALVEOLUS, SUPPLY, input_responses
from ventbench.system_id import Predictor

from . import small

INSPIRED = 30


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


def test_an_oscillation_of_the_supply_is_found_at_its_place_and_rate():
    acting = small.effect("pulsating_supply", "oscillation", amplitude=0.175, frequency=5.0)
    found = small.concluded(small.made(acting))
    assert found.names == ()
    assert found.unnamed is not None
    assert found.unnamed.swing is not None
    assert found.unnamed.name == SUPPLY
    swing = found.unnamed.swing
    assert swing.frequency == pytest.approx(5.0, abs=0.2)
    assert swing.course.shape == (8, small.SAMPLES)
    size = float(np.sqrt(np.mean(swing.course[:, :INSPIRED] ** 2)))
    assert size == pytest.approx(0.175 / np.sqrt(2), rel=0.3)
    assert swing.noise.sigma[0] == pytest.approx(0.2, rel=0.4)
    assert found.unnamed.nats > 20.0
