"""What the error that mechanisms leave may be."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ventbench.diagnosis.diagnose import _note_on_slow_noise
from ventbench.diagnosis.latent_inputs import ALVEOLUS, GAIN_SCATTER, MEASUREMENT, SUPPLY
from ventbench.diagnosis.remaining_error import (
    UnnamedEffect,
    _best_input,
    _is_negligible_input,
    _is_negligible_term,
    _slow_noise,
)

from . import small


def latent(place: str, nats: float, size: float = 0.2) -> Any:
    return SimpleNamespace(
        place=place, size=size, periodic=False, training_log_likelihood=nats,
        held_out_log_likelihood=np.full(6, nats / 6),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("nats", "noise", "scatter", "accepted"),
    [
        (30.0, 5.0, 5.0, True),
        (30.0, 25.0, 5.0, False),  # coloured noise explains nearly as much
        (30.0, 5.0, 25.0, False),  # so does a gain that differs from breath to breath
        (6.0, -20.0, -20.0, False),  # too little
    ],
)
def test_an_input_must_explain_more_than_every_nuisance(nats, noise, scatter, accepted):
    inputs = {
        place: latent(place, gain)
        for place, gain in (
            (ALVEOLUS, nats), (SUPPLY, nats - 5.0), (MEASUREMENT, noise), (GAIN_SCATTER, scatter),
        )
    }  # fmt: skip
    best = _best_input(inputs, np.zeros(6), small.SETTINGS)
    assert (best is not None) is accepted
    if best is not None:
        assert best.name == ALVEOLUS
        assert best.places[0][0] == ALVEOLUS


@pytest.mark.parametrize(("nats", "asked"), [(30.0, True), (3.0, False), (-30.0, False)])
def test_slow_noise_counts_if_held_out_breaths_ask_for_it(nats, asked):
    inputs = {place: latent(place, nats - 10.0) for place in (ALVEOLUS, SUPPLY, GAIN_SCATTER)}
    inputs[MEASUREMENT] = latent(MEASUREMENT, nats)
    slow = _slow_noise(inputs, np.zeros(6), small.SETTINGS)
    assert (slow is not None) is asked
    if slow is not None:
        assert slow.latent_input is inputs[MEASUREMENT]
        assert slow.nats == pytest.approx(nats)
        assert slow.places[0][0] == MEASUREMENT
        assert sum(weight for _, weight in slow.places) == pytest.approx(1.0)


@pytest.mark.parametrize(("size", "told"), [(0.8, True), (0.1, False)])
def test_slow_errors_that_are_left_are_told_if_they_are_large(size, told):
    sensor = latent(MEASUREMENT, 30.0, size)
    slow = UnnamedEffect(MEASUREMENT, None, sensor, 30.0, ((MEASUREMENT, 0.985), (SUPPLY, 0.015)))
    notes = _note_on_slow_noise(SimpleNamespace(slow_noise=slow), small.SETTINGS)  # type: ignore[arg-type]
    assert bool(notes) is told
    if notes:
        assert "0.8 cmH2O" in notes[0]
        assert "measurement 98.5 %" in notes[0]
    assert _note_on_slow_noise(SimpleNamespace(slow_noise=None), small.SETTINGS) == []  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("nats", "size", "names", "negligible"),
    [
        (40.0, 0.2, ("valve_hysteresis",), True),
        (40.0, 0.8, ("valve_hysteresis",), False),  # as large as an effect
        (400.0, 0.2, ("valve_hysteresis",), False),  # explains much
        (40.0, 0.2, (), False),  # nothing else is missing
    ],
)
def test_a_small_input_beside_strong_mechanisms_is_negligible(nats, size, names, negligible):
    evaluator: Any = SimpleNamespace(
        fit=lambda hypothesis, noise, start: SimpleNamespace(nats=0.0),
        held_out_log_likelihood=lambda fitted: np.full(4, fitted.nats / 4),
        settings=small.SETTINGS,
    )
    selected: Any = SimpleNamespace(names=names, noise=None, nats=3000.0)
    unnamed = UnnamedEffect(ALVEOLUS, None, latent(ALVEOLUS, nats, size), nats)
    assert _is_negligible_input(evaluator, selected, unnamed) is negligible


@pytest.mark.parametrize(
    ("nats", "explained", "noise", "names", "negligible"),
    [
        (40.0, 0.05, 0.2, ("valve_hysteresis",), True),
        (40.0, 0.3, 0.2, ("valve_hysteresis",), False),  # explains an error that is seen
        (400.0, 0.05, 0.2, ("valve_hysteresis",), True),  # less than half of the noise
        (400.0, 0.05, 0.02, ("valve_hysteresis",), False),  # explains much
        (40.0, 0.05, 0.02, ("valve_hysteresis",), True),
        (40.0, 0.05, 0.2, (), False),  # nothing else is missing
    ],
)
def test_a_term_that_explains_little_beside_strong_mechanisms_is_negligible(
    nats, explained, noise, names, negligible
):
    weight = np.ones((4, 1, 10))
    weight[0] = 0.0  # a breath that nobody measured
    wide: Any = SimpleNamespace(
        fit=lambda hypothesis, noise, start: SimpleNamespace(nats=0.0),
        held_out_log_likelihood=lambda fitted: np.full(4, fitted.nats / 4),
        held_out=SimpleNamespace(
            data=SimpleNamespace(weight=weight, measured=np.zeros((4, 1, 10)))
        ),
        predict=lambda fitted, partition: np.where(weight > 0.0, fitted.error, 100.0 * fitted.nats),
        settings=small.SETTINGS,
    )
    model_noise = SimpleNamespace(sigma=(noise,))
    selected: Any = SimpleNamespace(
        names=names, noise=model_noise, nats=3000.0, error=np.hypot(1.0, explained)
    )
    with_term: Any = SimpleNamespace(nats=3000.0 + nats, noise=model_noise, error=1.0)
    assert _is_negligible_term(wide, selected, with_term, nats) is negligible
