"""The Gymnasium environment: its checker's opinion, and the same score as the benchmark's."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from ventbench.base.errors import InputError

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")

from ventbench import gym_env  # noqa: E402
from ventbench.base import precision  # noqa: E402
from ventbench.plants import frozen  # noqa: E402
from ventbench.task import environment, protocol, rollouts  # noqa: E402
from ventbench.task.lungs import LUNG_IDS  # noqa: E402
from ventbench.task.metrics.score import run_error  # noqa: E402
from ventbench.task.rollouts import Script  # noqa: E402

NAME = "ventbench.gym_env:ventbench/Ventilator-v1"

#: Environments at once, in all tests: what is compiled for a number serves that number alone.
MANY = 12


def test_the_checker_of_gymnasium_has_no_complaint():
    from gymnasium.utils.env_checker import check_env

    made = gymnasium.make(NAME)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made.unwrapped, skip_render_check=True)


def test_registered_by_name():
    made = gymnasium.make("ventbench/Ventilator-v1", lung="R5C10")
    assert isinstance(made.unwrapped, gym_env.Ventilator)
    assert made.spec is not None
    assert made.spec.id == "ventbench/Ventilator-v1"


def test_a_breath_scores_as_the_benchmark_does():
    made = gym_env.Ventilator(lung="R20C50", pip=25.0, noise=False)
    actions = np.random.default_rng(0).uniform(-1.0, -0.4, 33).astype(np.float32)
    seen, info = made.reset(seed=1)
    assert info["pip"] == 25.0
    np.testing.assert_allclose(seen[:2], [5 / 40, 25 / 40], rtol=1e-6)
    rewards = []
    for k, action in enumerate(actions):
        seen, reward, ended, cut, info = made.step(action[None])
        rewards.append(reward)
        assert (ended, cut) == (k == 32, False)
        assert seen in made.observation_space
        np.testing.assert_allclose(seen[-3], action, rtol=1e-5)
    with precision.float64():
        u_in = np.tile(np.append(50.0 + 50.0 * actions, 0.0), protocol.BREATHS)
        plants = frozen.load().plants
        import jax
        import jax.numpy as jnp

        plant = jax.tree.map(lambda x: jnp.asarray(x[LUNG_IDS.index("R20C50")]), plants)
        run, _ = rollouts.closed_loop(
            plant, Script(jnp.asarray(u_in)), environment.nominal_scenario(25.0)
        )
    wanted = float(run_error(run.pressure, 25.0))
    assert info["error"] == pytest.approx(wanted, rel=1e-4)
    assert (20.0 - 10.0 * sum(rewards)) / 34 == pytest.approx(wanted, rel=1e-4)


def test_seeds_repeat_and_lungs_and_pips_vary():
    made = gym_env.Ventilator()
    kinds = set()
    for seed in range(20):
        first, info = made.reset(seed=seed)
        again, _ = made.reset(seed=seed)
        np.testing.assert_array_equal(first, again)
        kinds.add((info["lung"], round(info["pip"] / 5)))
    assert len(kinds) > 10


def test_what_cannot_be_done_is_said():
    with pytest.raises(InputError, match="R7C7 is not a scored lung"):
        gym_env.Ventilator(lung="R7C7")
    with pytest.raises(InputError, match="PIP 80 cmH2O"):
        gym_env.Ventilator(pip=80.0)
    made = gym_env.Ventilator(lung="R5C10")
    with pytest.raises(InputError, match="call reset"):
        made.step(np.zeros(1, np.float32))
    made.reset(seed=0)
    with pytest.raises(InputError, match="the action is nan"):
        made.step(np.array([np.nan], np.float32))


def test_many_at_once_are_each_alone():
    many = gym_env.VentilatorVector(MANY, noise=False)
    seen, info = many.reset(seed=3)
    actions = np.random.default_rng(0).uniform(-1.0, 0.0, (33, MANY, 1)).astype(np.float32)
    at = 7
    alone = gym_env.Ventilator(lung=info["lung"][at], pip=info["pip"][at], noise=False)
    seen_alone, _ = alone.reset(seed=0)
    np.testing.assert_allclose(seen[at], seen_alone, rtol=1e-6)
    for action in actions:
        seen, rewards, ended, _, info = many.step(action)
        seen_alone, reward, ended_alone, _, info_alone = alone.step(action[at])
        np.testing.assert_allclose(seen[at], seen_alone, rtol=2e-5, atol=1e-6)
        np.testing.assert_allclose(rewards[at], reward, rtol=2e-5, atol=1e-6)
        assert ended[at] == ended_alone
    np.testing.assert_allclose(info["error"][at], info_alone["error"], rtol=2e-5)


def test_the_next_step_after_the_end_begins_new_breaths():
    many = gymnasium.make_vec(NAME, num_envs=MANY, lung="R5C10")
    first, info = many.reset(seed=1)
    assert list(info["lung"]) == ["R5C10"] * MANY
    assert sorted(np.round(info["pip"] / 5.0)) == sorted([2, 3, 4, 5, 6, 7] * (MANY // 6))
    for _ in range(33):
        _, _, ended, _, _ = many.step(np.zeros((MANY, 1), np.float32))
    assert ended.all()
    seen, rewards, ended, _, _ = many.step(np.ones((MANY, 1), np.float32))
    assert not ended.any()
    assert not rewards.any()
    assert not np.array_equal(seen, first), "new deviations for new breaths"
    np.testing.assert_array_equal(many.reset(seed=1)[0], first)


def test_wrong_input_of_many():
    with pytest.raises(InputError, match="num_envs is 0"):
        gym_env.VentilatorVector(0)
    many = gym_env.VentilatorVector(MANY, lung="R5C10", pip=20.0)
    with pytest.raises(InputError, match="reset"):
        many.step(np.zeros((MANY, 1), np.float32))
    many.reset(seed=0)
    with pytest.raises(InputError, match="action 1 is nan"):
        many.step(np.array([[0.0], [np.nan]] * (MANY // 2), np.float32))
