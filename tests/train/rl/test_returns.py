"""Returns, advantages and targets against loops in numpy and formulas."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from submissions.dqn.train import double_q_target
from submissions.ppo.train import clipped_loss, log_probability
from ventbench.train.rl import environment

RNG = np.random.default_rng(0)
REWARDS, VALUES = RNG.normal(size=(7, 3)), RNG.normal(size=(7, 3))


def test_discounted_is_a_geometric_sum():
    found = environment.discounted(jnp.asarray(REWARDS), 0.9)
    wanted = [sum(0.9**k * REWARDS[t + k] for k in range(7 - t)) for t in range(7)]
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


@pytest.mark.parametrize("trace", [0.0, 0.6, 1.0])
def test_advantages_are_weighted_sums_of_one_step_errors(trace):
    following = np.vstack([VALUES[1:], np.zeros((1, 3))])
    errors = REWARDS + 0.9 * following - VALUES
    wanted = [sum((0.9 * trace) ** k * errors[t + k] for k in range(7 - t)) for t in range(7)]
    found = environment.advantages(jnp.asarray(REWARDS), jnp.asarray(VALUES), 0.9, trace)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_advantages_with_full_trace_are_returns_minus_values():
    rewards, values = jnp.asarray(REWARDS), jnp.asarray(VALUES)
    found = environment.advantages(rewards, values, 0.9, 1.0)
    wanted = environment.discounted(rewards, 0.9) - values
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_double_q_takes_the_targets_value_of_the_online_choice():
    online = jnp.array([[1.0, 3.0, 2.0], [5.0, 4.0, 0.0]])
    target = jnp.array([[10.0, 20.0, 30.0], [40.0, 50.0, 60.0]])
    reward, discount = jnp.array([1.0, 2.0]), jnp.array([0.5, 0.0])
    found = double_q_target(reward, discount, online, target)
    np.testing.assert_allclose(found, [1.0 + 0.5 * 20.0, 2.0])


def test_clipped_loss_gains_nothing_beyond_the_clip():
    ratio = jnp.array([0.5, 0.9, 1.1, 2.0, 0.5, 2.0])
    advantage = jnp.array([1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    found = clipped_loss(ratio, advantage, 0.2)
    np.testing.assert_allclose(found, [-0.5, -0.9, -1.1, -1.2, 0.8, 2.0], rtol=1e-6)


def test_log_probability_is_a_gaussians_up_to_a_constant():
    from scipy.stats import norm

    action, mean, spread = np.array([0.3, -1.0, 2.0]), 0.5, 0.7
    found = log_probability(jnp.asarray(action), jnp.asarray(mean), jnp.log(spread))
    wanted = norm.logpdf(action, mean, spread) + 0.5 * np.log(2 * np.pi)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
