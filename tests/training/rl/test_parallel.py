"""Small trainings on textbook lungs: they learn, repeat to the bit, and go on where they were."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ventbench.errors import InputError
from ventbench.lungs import LUNGS
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.training.rl import parallel
from ventbench.training.rl.dqn import DQN
from ventbench.training.rl.policy_gradient import PolicyGradient
from ventbench.training.rl.ppo import PPO

PG = PolicyGradient(breaths=6, iterations=8, widths=(8,), learning_rate=1e-2)
SMALL_PPO = PPO(breaths=12, iterations=4, widths=(8,), epochs=2, minibatches=2)
SMALL_DQN = DQN(breaths=6, iterations=8, widths=(8,), updates=2, batch=16, memory=24)


@pytest.fixture(scope="module")
def lung():
    """R5C10 for two runs, leaves ``(2, 1)``."""
    one = stack([single_compartment(LUNGS[0])])
    return jax.tree.map(lambda x: jnp.stack([x, x]), one)


@pytest.mark.parametrize("method", [PG, SMALL_PPO, SMALL_DQN], ids=["pg", "ppo", "dqn"])
def test_same_seed_same_bits_and_resuming_changes_nothing(method, lung, tmp_path):
    whole = parallel.train(method, lung, (0, 1), chunk=2, file=tmp_path / "a.npz")

    def stop(share, error):
        if share > 0.4:
            raise KeyboardInterrupt

    file = tmp_path / "b.npz"
    with pytest.raises(KeyboardInterrupt):
        parallel.train(method, lung, (0, 1), chunk=2, file=file, progress=stop, save_seconds=0.0)
    again = parallel.train(method, lung, (0, 1), chunk=2, file=file)
    for one, other in zip(
        jax.tree.leaves(whole.policies), jax.tree.leaves(again.policies), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(whole.curves, again.curves)
    assert not np.array_equal(whole.curves[0], whole.curves[1])  # another seed is another training
    assert np.all(np.diff(again.seconds) > 0)
    assert whole.episodes.tolist() == list(range(0, method.iterations * method.breaths + 1,
                                                 2 * method.breaths))  # fmt: skip


def test_a_checkpoint_of_other_settings_is_refused(lung, tmp_path):
    file = tmp_path / "a.npz"
    parallel.train(SMALL_PPO, lung, (0, 1), chunk=2, file=file)
    with pytest.raises(InputError, match=r"work with other settings \(recipe\)"):
        parallel.train(replace(SMALL_PPO, clip=0.1), lung, (0, 1), chunk=2, file=file)
    file.write_bytes(b"no zip")
    with pytest.raises(InputError, match="is not a checkpoint"):
        parallel.train(SMALL_PPO, lung, (0, 1), chunk=2, file=file)


@pytest.fixture(scope="module")
def soft_lung():
    """R20C20, where the PID swings, likewise."""
    one = stack([single_compartment(LUNGS[4])])
    return jax.tree.map(lambda x: jnp.stack([x, x]), one)


def test_policy_gradient_improves_on_the_pid(soft_lung):
    found = parallel.train(replace(PG, iterations=160), soft_lung, (0, 1), chunk=40)
    assert np.all(found.curves[:, -1] < 0.6 * found.curves[:, 0])
    assert np.all(found.validation == np.nanmin(found.validation_curves, axis=1))


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [PPO(breaths=48, iterations=80), DQN(breaths=24, iterations=240, explored=0.3)],
    ids=["ppo", "dqn"],
)
def test_ppo_and_dqn_improve_on_the_pid(method, soft_lung):
    found = parallel.train(method, soft_lung, (0, 1), chunk=40)
    # DQN does not start as the PID, which the policy gradient does before its first update.
    pid = parallel.train(replace(PG, iterations=1), soft_lung, (0, 1), chunk=1).curves[:, 0]
    assert np.all(found.curves[:, -1] < 0.4 * pid)


def test_the_replay_holds_the_last_breaths_and_their_following_features(lung):
    plant = jax.tree.map(lambda x: jnp.asarray(x[0], jnp.float32), lung)
    method = replace(SMALL_DQN, updates=1, steps=3)
    state = method.init(jax.random.key(0))
    first = method.iterate(state, plant)
    count = 6 * 33
    replay = jax.tree.map(np.asarray, first.replay)
    seen = replay.features[:count].reshape(33, 6, -1)
    np.testing.assert_array_equal(replay.following[:count].reshape(33, 6, -1)[:30], seen[3:])
    discount = replay.discount[:count].reshape(33, 6)
    np.testing.assert_allclose(discount[:30], method.discount**3, rtol=1e-6)
    assert not discount[30:].any()
    assert not replay.features[count:].any()
    for _ in range(4):  # the fifth overwrites the first of four
        first = method.iterate(first, plant)
    assert not np.array_equal(np.asarray(first.replay.features[:count]), replay.features[:count])
