"""Cells that are learned from, features, and breaths in a scan."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.base import compilation
from ventbench.controllers import residual
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import GaussianPolicy, Residual, TanhNetwork, init_parameters
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.task import draws, protocol, rollouts
from ventbench.task import environment as env
from ventbench.task.interfaces import Observation
from ventbench.task.lungs import LUNGS, Lung
from ventbench.task.metrics.score import run_error
from ventbench.train.rl import environment


@pytest.fixture(scope="module")
def lungs():
    return stack([single_compartment(lung) for lung in LUNGS])


@pytest.fixture(scope="module")
def all_lungs(lungs):
    return environment.Lungs(jax.tree.map(lambda x: x[None], lungs), jnp.ones((6, 6)))


@pytest.fixture(scope="module")
def cells(all_lungs):
    return environment.draw(jax.random.key(3), all_lungs, 1200).cells


def test_deviations_have_the_distributions_of_the_draws(cells):
    nominal = np.asarray(protocol.PIPS)[np.arange(1200) // 6 % 6]
    found = {
        "pip_shift": cells.pip - nominal,
        "peep_shift": cells.peep - protocol.PEEP,
        "start_shift": cells.start - cells.peep,
        "dt_scale": cells.dt / protocol.DT,
        "r_scale": cells.r_scale,
        "c_scale": cells.c_scale,
        "delay": cells.delay,
    }
    assert found.keys() == draws.RANGES.keys()
    for name, (low, high) in draws.RANGES.items():
        values = np.asarray(found[name], float)
        assert low - 1e-5 <= values.min() < low + 0.02 * (high - low), name
        assert high - 0.02 * (high - low) < values.max() <= high + 1e-5, name
        assert abs(values.mean() - (low + high) / 2) < 0.03 * (high - low), name
    spread = np.std(np.asarray(cells.noise), axis=(1, 2))
    assert abs(spread.mean() - np.mean(draws.NOISE_SD)) < 0.005
    assert np.all(np.asarray(cells.quantum, float) == np.float32(draws.QUANTUM))


def test_nominal_cells_are_the_protocols(lungs):
    lung = environment.Lungs(jax.tree.map(lambda x: x[None, :1], lungs), jnp.ones((1, 6)))
    found = environment.draw(jax.random.key(0), lung, 6, vary=False).cells
    wanted = env.nominal_scenario(protocol.PIPS)
    for name in ("pip", "peep", "start", "dt", "r_scale", "c_scale", "delay", "quantum"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-6)
    assert not np.any(found.noise)


def test_the_pid_inside_the_features_is_the_pid(lungs):
    with compilation.float64():
        cells = env.nominal_scenario(np.asarray(protocol.PIPS))
        network = TanhNetwork((4,), 1)
        untrained = GaussianPolicy(init_parameters(network, jax.random.key(0)), network)
        lung = jax.tree.map(lambda x: x[2], lungs)
        found, _ = rollouts.closed_loop(lung, untrained, cells)
        wanted, _ = rollouts.closed_loop(lung, PID(*residual.GAINS), cells)
    # Its command is cut to the valve's range before the correction, of zero here, is added.
    cut = np.clip(wanted.requested, 0.0, protocol.U_MAX)
    np.testing.assert_allclose(found.requested, cut, atol=1e-9)
    np.testing.assert_allclose(found.pressure, wanted.pressure, atol=1e-9)


def test_the_features_are_those_of_the_residual_controller():
    network = Residual(PID(*residual.GAINS), ())
    assert residual.FEATURES == 30
    seen = Observation(
        jnp.asarray(0.0),
        jnp.asarray(0.03),
        jnp.asarray(5.0),
        jnp.asarray(20.0),
        jnp.full((10,), 15.0),
        jnp.asarray(5.0),
    )
    _, found, base = residual.features(residual.init_features(()), seen)
    _, wanted, asked = network.features(network.init(()), seen)
    np.testing.assert_array_equal(found, wanted)
    a = 0.03 / 0.53
    assert float(asked) == pytest.approx(6 * 15 + 6 * a * 15 + 0.3 * a * 15, rel=1e-6)
    assert float(base) == pytest.approx(min(float(asked), 100.0))


def test_rewards_and_errors_are_the_scores(lungs):
    weights = jnp.ones((1, 6))
    lung = jax.tree.map(lambda x: jnp.asarray(x[None, 2:3], jnp.float32), lungs)
    drawn = environment.draw(jax.random.key(0), environment.Lungs(lung, weights), 6, vary=False)
    pid = PID(*residual.GAINS)
    _, _, rewards = environment.roll(drawn, lambda k, x, base: (base, None), jax.random.key(1))
    start = np.asarray(drawn.cells.pip - drawn.cells.start)
    each = rewards.sum(axis=0).reshape(3, 6)  # without noise all breaths are alike
    np.testing.assert_allclose(each[0], each[2], rtol=1e-4)
    from_rewards = (start - environment.REWARD_SCALE * each[1]) / 34
    errors = environment.errors(drawn, pid)
    run, _ = rollouts.closed_loop(
        jax.tree.map(lambda x: x[2], lungs),
        pid,
        env.nominal_scenario(np.asarray(protocol.PIPS)),
    )
    wanted = run_error(run.pressure, np.asarray(protocol.PIPS)[:, None, None])
    np.testing.assert_allclose(errors, wanted, rtol=1e-4)
    np.testing.assert_allclose(from_rewards, wanted, rtol=1e-4)


@pytest.fixture(scope="module")
def rig_lungs():
    """Two plants of each of two lungs, the second of twice the resistance; weights that tell."""
    with compilation.float32():
        first = stack([single_compartment(lung) for lung in LUNGS[:2]])
        second = stack([single_compartment(Lung(2 * lung.R, lung.C)) for lung in LUNGS[:2]])
        weights = jnp.arange(12.0).reshape(2, 6) + 1.0
        return environment.Lungs(stack([first, second]), weights)


def test_episodes_on_rigs_have_any_plant_their_weight_and_the_ranges_of_the_draws(rig_lungs):
    drawn = environment.draw(jax.random.key(2), rig_lungs, 480)
    lung, pip = np.arange(480) % 2, np.arange(480) // 2 % 6
    np.testing.assert_array_equal(drawn.weight, 6 * lung + pip + 1)
    ratio = np.asarray(drawn.plants.R) / np.array([lung.R for lung in LUNGS[:2]])[lung]
    assert set(np.round(ratio, 3)) == {1.0, 2.0}
    assert abs(np.mean(ratio > 1.5) - 0.5) < 0.1
    low, high = draws.RANGES["r_scale"]
    assert low <= drawn.cells.r_scale.min() < 0.85
    assert 1.15 < drawn.cells.r_scale.max() <= high
    assert drawn.cells.noise.shape == (480, 3, 34)
    nominal = environment.draw(jax.random.key(2), rig_lungs, 12, vary=False)
    np.testing.assert_array_equal(nominal.plants.R, np.tile(rig_lungs.plants.R[0], 6))
    assert not np.any(nominal.cells.noise)


def test_three_breaths_remember_the_one_before_and_score_as_the_protocol(rig_lungs):
    """Rewards and errors against the scorer's loop, with a policy that looks back."""
    network = TanhNetwork((4,), 1, first=0.5)
    policy = GaussianPolicy(init_parameters(network, jax.random.key(1)), network)
    drawn = environment.draw(jax.random.key(3), rig_lungs, 4)

    def act(key, x, base):
        mean = jnp.asarray(network.apply(policy.parameters, x))[..., 0]
        return base + residual.SCALE * mean, x[..., 0]

    x, kept, rewards = environment.roll(drawn, act, jax.random.key(1))
    assert x.shape == (environment.MOVES, 12, residual.FEATURES)
    np.testing.assert_array_equal(kept, x[..., 0])
    before = np.asarray(x).reshape(environment.MOVES, 3, 4, -1)[..., 8:14]
    assert not before[:, 0].any()
    assert before[:, 1:].any()
    found, _ = rollouts.closed_loop(drawn.plants, policy, drawn.cells)
    error = np.abs(np.asarray(found.pressure) - np.asarray(drawn.cells.pip)[:, None, None])
    weighted = error * np.asarray(drawn.weight)[:, None, None]
    wanted = -weighted[..., 1:].transpose(2, 1, 0)
    given = np.asarray(rewards).reshape(environment.MOVES, 3, 4) * environment.REWARD_SCALE
    np.testing.assert_allclose(given, wanted, rtol=2e-3, atol=2e-3)
    scored = weighted[:, protocol.SCORED_BREATHS].mean(axis=(1, 2))
    np.testing.assert_allclose(environment.errors(drawn, policy), scored, rtol=1e-3)
