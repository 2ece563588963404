"""Shares of a window in past samples, against counting."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ventbench.base.compilation import float64
from ventbench.physics.dead_time import window_weights

POINTS = 20_000


def counted(start, length, past):
    """Shares by a fine grid of points: in which sample does each lie?"""
    points = start + (np.arange(POINTS) + 0.5) / POINTS * length
    edges = -np.cumsum(past)  # starts of the samples before, latest first
    sample = (points[:, None] < np.append(0.0, edges)).sum(axis=1)
    return np.bincount(sample, minlength=len(past) + 2) / POINTS


def found(start, length, past):
    with float64():
        durations = tuple(jnp.asarray(x, float) for x in past)
        weights = window_weights(jnp.asarray(start, float), jnp.asarray(length, float), durations)
        return np.asarray(weights)


@settings(max_examples=60)
@given(
    st.floats(-0.3, 0.03),
    st.floats(0.001, 0.05),
    st.lists(st.floats(0.01, 0.05), min_size=3, max_size=3),
)
def test_equals_counting_and_adds_up_to_one(start, length, past):
    weights = found(start, length, past)
    np.testing.assert_allclose(weights, counted(start, length, past), atol=2.0 / POINTS)
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert (weights >= 0.0).all()


@pytest.mark.parametrize(
    ("start", "expected"),
    [
        (0.0, [1, 0, 0, 0]),  # no delay: all of it now
        (-0.01, [0, 1, 0, 0]),  # a whole window ago
        (-0.005, [0.5, 0.5, 0, 0]),
        (-0.035, [0, 0.5, 0.5, 0]),  # across the edge of two samples before
        (-0.9, [0, 0, 0, 1]),  # before all that is remembered
        (-0.055, [0, 0, 0.5, 0.5]),
    ],
)
def test_windows_by_hand(start, expected):
    np.testing.assert_allclose(found(start, 0.01, [0.03, 0.02]), expected, atol=1e-12)


def test_batches_and_gradients():
    """Piecewise linear in the start: a window of 10 ms loses 100 of its share a second."""
    starts = jnp.asarray([-0.005, -0.035])
    past = (jnp.full(2, 0.03), jnp.full(2, 0.02))
    batch = jnp.stack(window_weights(starts, jnp.full(2, 0.01), past))
    assert batch.shape == (4, 2)
    single = (jnp.asarray(0.03), jnp.asarray(0.02))
    slope = jax.jacobian(lambda s: jnp.stack(window_weights(s, jnp.asarray(0.01), single)))(
        starts[0]
    )
    np.testing.assert_allclose(slope, [100.0, -100.0, 0.0, 0.0], atol=1e-3)
