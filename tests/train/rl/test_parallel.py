"""Trainings side by side: the same bits for the same seed, also after an interruption.

How the trainings are run is tested with a method that costs nothing to compile; what each real
method learns, by its own iterations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from proofs.studies.samples import PolicyGradient
from submissions.dqn.train import DQN
from submissions.ppo.train import PPO
from ventbench.base.errors import InputError
from ventbench.controllers.pid import PID
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import stack
from ventbench.task.lungs import LUNGS
from ventbench.train.rl import environment
from ventbench.train.rl import train as parallel

PG = PolicyGradient(breaths=6, iterations=160, widths=(8,), learning_rate=1e-2)
SMALL_PPO = PPO(breaths=12, iterations=4, widths=(8,), epochs=2, minibatches=2)
SMALL_DQN = DQN(breaths=6, iterations=8, widths=(8,), updates=1, batch=16, memory=24)
METHODS = {"pg": PG, "ppo": SMALL_PPO, "dqn": SMALL_DQN}


@flax.struct.dataclass
class WalkState:
    """State of :class:`RandomWalk`."""

    gains: Array
    key: Array


@dataclass(frozen=True)
class RandomWalk:
    """A method that learns nothing: the gains of a PID take random steps."""

    breaths: int = 3
    iterations: int = 8
    step: float = 0.5

    def init(self, key: Array) -> WalkState:
        return WalkState(jnp.full(3, 2.0), key)

    def iterate(self, state: WalkState, plants: Any) -> WalkState:
        use, key = jax.random.split(state.key)
        return WalkState(jnp.abs(state.gains + self.step * jax.random.normal(use, (3,))), key)

    def policy(self, state: WalkState) -> PID:
        return PID(*state.gains)


def lungs(index: int) -> Any:
    """One plant of one lung for two runs, leaves ``(2, 1, 1)``."""
    single = stack([stack([single_compartment(LUNGS[index])])])
    made = environment.Lungs(single, jnp.ones((1, 6)))
    return jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), made)


WALK: Any = RandomWalk()


@pytest.mark.slow
def test_same_seed_same_bits_and_resuming_changes_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(parallel, "SAVE_SECONDS", 0.0)
    whole = parallel.train(WALK, lungs(0), (0, 1), chunk=2, file=tmp_path / "a.npz")

    def stop(share, error):
        if share > 0.4:
            raise KeyboardInterrupt

    file = tmp_path / "b.npz"
    with pytest.raises(KeyboardInterrupt):
        parallel.train(WALK, lungs(0), (0, 1), chunk=2, file=file, progress=stop)
    again = parallel.train(WALK, lungs(0), (0, 1), chunk=2, file=file)
    for leaf, other in zip(
        jax.tree.leaves(whole.policies), jax.tree.leaves(again.policies), strict=True
    ):
        np.testing.assert_array_equal(leaf, other)
    np.testing.assert_array_equal(whole.curves, again.curves)
    assert not np.array_equal(whole.curves[0], whole.curves[1])  # another seed is another training
    assert np.all(np.diff(again.seconds) > 0)
    assert whole.episodes.tolist() == [0, 6, 12, 18, 24]
    # What is kept is the policy with the lowest error on fresh cells.
    told: list[np.ndarray] = []
    lowest = parallel.train(
        WALK, lungs(0), (0, 1), chunk=2, progress=lambda share, errors: told.append(errors)
    )
    np.testing.assert_array_equal(lowest.validation, told[-1])
    assert np.all(np.diff(told, axis=0) <= 0)


def test_a_checkpoint_of_other_settings_is_refused(tmp_path):
    file = tmp_path / "a.npz"
    parallel.train(WALK, lungs(0), (0, 1), chunk=2, file=file)
    with pytest.raises(InputError, match=r"work with other settings \(recipe\)"):
        parallel.train(replace(WALK, step=0.1), lungs(0), (0, 1), chunk=2, file=file)
    file.write_bytes(b"no zip")
    with pytest.raises(InputError, match="is not a checkpoint"):
        parallel.train(WALK, lungs(0), (0, 1), chunk=2, file=file)


@pytest.fixture(scope="module")
def iterations():
    """Iterations of each method on one lung, compiled when they are first asked for."""
    return {name: jax.jit(method.iterate) for name, method in METHODS.items()}


def plant(index: int) -> Any:
    """One lung in float32."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[0], jnp.float32), lungs(index))


@pytest.mark.parametrize("name", METHODS)
def test_an_iteration_learns_from_its_key_alone(name, iterations):
    method, lung = METHODS[name], plant(0)
    first, again, other = (
        iterations[name](method.init(jax.random.key(seed)), lung) for seed in (0, 0, 1)
    )

    def weights(state: Any) -> list[np.ndarray]:
        leaves = jax.tree.leaves(method.policy(state).parameters)
        return [np.asarray(leaf) for leaf in leaves]

    for leaf, same in zip(weights(first), weights(again), strict=True):
        np.testing.assert_array_equal(leaf, same)
        assert np.all(np.isfinite(leaf))
    assert not np.array_equal(weights(first)[1], weights(other)[1])
    start = weights(method.init(jax.random.key(0)))
    assert any(not np.array_equal(a, b) for a, b in zip(start, weights(first), strict=True))


def test_policy_gradient_improves_on_the_pid(iterations):
    lung = plant(4)  # R20C20, where the PID swings
    state = PG.init(jax.random.key(0))
    before = float(parallel.nominal_error(lung, PG.policy(state)))
    for _ in range(PG.iterations):
        state = iterations["pg"](state, lung)
    assert float(parallel.nominal_error(lung, PG.policy(state))) < 0.6 * before


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [PPO(breaths=48, iterations=80), DQN(breaths=24, iterations=240, explored=0.3)],
    ids=["ppo", "dqn"],
)
def test_ppo_and_dqn_improve_on_the_pid(method):
    found = parallel.train(method, lungs(4), (0, 1), chunk=40)
    # DQN does not start as the PID, which the policy gradient does before its first update.
    pid = parallel.train(replace(PG, iterations=1), lungs(4), (0, 1), chunk=1).curves[:, 0]
    assert np.all(found.curves[:, -1] < 0.4 * pid)


def test_the_replay_holds_the_last_breaths_and_their_following_features(iterations):
    steps, breaths = environment.MOVES, SMALL_DQN.breaths
    count = breaths * steps
    first = iterations["dqn"](SMALL_DQN.init(jax.random.key(0)), plant(0))
    replay = jax.tree.map(np.asarray, first.replay)
    seen = replay.features[:count].reshape(steps, breaths, -1)
    following = replay.following[:count].reshape(steps, breaths, -1)
    np.testing.assert_array_equal(following[:-1], seen[1:])
    discount = replay.discount[:count].reshape(steps, breaths)
    np.testing.assert_allclose(discount[:-1], SMALL_DQN.discount, rtol=1e-6)
    assert not discount[-1].any()
    assert not replay.features[count:].any()
    for _ in range(4):  # the fifth overwrites the first of four
        first = iterations["dqn"](first, plant(0))
    assert not np.array_equal(np.asarray(first.replay.features[:count]), replay.features[:count])
