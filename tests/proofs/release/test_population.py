"""Fit of the population: means of a lung and of all, gains of breaths, and known rigs."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from proofs.release.population import _scatter, fit_population
from ventbench.base import compilation
from ventbench.plants import frozen
from ventbench.plants.hybrid import LUNG, NAMES, from_vector, to_vector
from ventbench.train.rigs.data import Groups, InspirationData
from ventbench.train.rigs.fit import simulate
from ventbench.train.rigs.population import design_of, scales


def test_lungs_have_means_of_their_own_and_ventilators_share_theirs():
    design = design_of(["R5C10", "R20C50", "R5C10"])
    beta = np.arange(design.shape[2], dtype=float)
    means = design @ beta
    np.testing.assert_array_equal(means[0], means[2])
    np.testing.assert_array_equal(means[0, len(LUNG) :], means[1, len(LUNG) :])
    assert np.all(means[0, : len(LUNG)] != means[1, : len(LUNG)])
    assert np.linalg.matrix_rank(design.reshape(-1, design.shape[2])) == design.shape[2]
    assert scales().shape == (len(NAMES),)


def test_scatter_is_that_within_sessions():
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(200), 5)
    gain = 0.12 * rng.standard_normal(1000) + np.repeat(rng.normal(0, 1, 200), 5)
    off, sd, lag = _scatter(gain, group)
    assert sd == pytest.approx(0.12, rel=0.05)
    assert off.std() == pytest.approx(sd)
    # Neighbours around a mean of five that is estimated from them: -1/5.
    assert lag == pytest.approx(-0.2, abs=0.06)


def test_rigs_of_known_size_are_told_apart_through_the_gains_of_their_breaths():
    official, rng = frozen.load(), np.random.default_rng(1)
    scored = jax.tree.map(lambda leaf: np.asarray(leaf)[0], official.members)
    lungs, sessions, each = ["R5C20"] * 3 + ["R20C20"] * 3, list(range(6)), 12
    first = {"R5C20": official.rigs[1][0], "R20C20": official.rigs[4][0]}
    base = to_vector(scored)[[first[lung] for lung in lungs]]
    size = np.array([0.15, 0.0, -0.15, -0.1, 0.1, 0.0])
    true = base.copy()
    true[:, NAMES.index("valve_size")] += size
    at = np.repeat(np.arange(6), each)
    gain = 0.05 * rng.standard_normal(len(at))
    n, samples = len(at), 30
    u_in = rng.uniform(5.0, 35.0, (n, 1)) + 10.0 * np.exp(
        -np.arange(samples) / rng.uniform(3, 9, (n, 1))
    )
    groups = Groups(*(jnp.asarray(at) for _ in range(3)))
    zeros: Any = np.zeros((n, samples))
    make: Any = InspirationData
    data = make(
        groups,
        np.full(n, 5.0),
        np.ones(n),
        u_in,
        np.full((n, samples), 0.032),
        zeros,
        np.full((n, samples), 1.0 / samples),
    )
    with compilation.float64():
        rigs: Any = from_vector(true[at], np)
        rigs = rigs.replace(slopes=rigs.slopes * np.exp(gain)[:, None])
        pressure = simulate(
            jax.tree.map(jnp.asarray, rigs), data.start, jax.tree.map(jnp.asarray, data)
        )
    noisy = np.asarray(pressure) + 0.2 * rng.standard_normal((n, samples))
    data = data.replace(pressure=noisy)
    found = fit_population(from_vector(base, np), data, sessions, lungs, np.ones(n), renewals=5)
    at_20 = found.population.units[:, NAMES.index("valve_size")]
    resistance = found.population.units[:, NAMES.index("resistance")]
    # What pressures tell is the product of the valve's size and the resistance.
    product = at_20 + resistance - base[:, NAMES.index("resistance")]
    assert np.corrcoef(product, size)[0, 1] > 0.9
    assert found.gain_sd == pytest.approx(0.05, rel=0.3)
