"""Train PPO on the ranked task, compiled whole: environment, rollouts and updates are pure JAX.

The number of iterations may follow as an argument: 500 by default, about two minutes on two cores.
"""

import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax.scipy.stats import norm

from ventbench.base.files import write_json
from ventbench.train.rl import environment
from ventbench.train.rl.environment import advantages

ITERATIONS = int(sys.argv[1]) if len(sys.argv) > 1 else 500
ENVIRONMENTS, EPOCHS, PARTS = 48, 4, 4
LUNGS = environment.load_lungs(rigs="training")


class Network(nn.Module):
    """Mean of the action, and the value; the mean starts as 10 % and 3 % a cmH2O of error."""

    @nn.compact
    def __call__(self, x):
        body = partial(nn.Dense, kernel_init=nn.initializers.orthogonal(2.0**0.5))
        actor = nn.tanh(body(64)(nn.tanh(body(64)(x))))
        critic = nn.tanh(body(64)(nn.tanh(body(64)(x))))
        start = nn.initializers.orthogonal(0.01)
        mean = nn.Dense(1, kernel_init=start, bias_init=nn.initializers.constant(-0.8))(actor)
        error = x[..., 1] - x[..., 0]  # in 40 cmH2O; an action of 1 is 50 %
        return mean[..., 0] + 2.4 * error, nn.Dense(1)(critic)[..., 0]


network = Network()
optimiser = optax.chain(
    optax.clip_by_global_norm(0.5),
    optax.adam(optax.linear_schedule(1e-3, 0.0, ITERATIONS * EPOCHS * PARTS)),
)


def remember(memory, seen):
    """What the network sees: the observation, and the three before it in the same episode."""
    memory = jnp.concatenate([seen[..., None, :], memory[..., :-1, :]], axis=-2)
    return memory, memory.reshape(*memory.shape[:-2], -1)


def rollout(parameters, key):
    """One episode of each environment; arrays of shape (STEPS, ENVIRONMENTS, ...)."""
    reset_key, act_key = jax.random.split(key)
    state, seen = jax.vmap(environment.reset, in_axes=(0, None))(
        jax.random.split(reset_key, ENVIRONMENTS), LUNGS
    )

    def act(carry, key):
        state, seen, memory = carry
        memory, x = remember(memory, seen)
        mean, value = network.apply(parameters["network"], x)
        spread = parameters["log_spread"]
        action = mean + jnp.exp(spread) * jax.random.normal(key, mean.shape)
        state, seen, reward, _ = jax.vmap(environment.step)(state, action)
        kept = x, action, norm.logpdf(action, mean, jnp.exp(spread)), value, reward
        return (state, seen, memory), kept

    memory = jnp.zeros((ENVIRONMENTS, 4, environment.OBSERVATION))
    keys = jax.random.split(act_key, environment.STEPS)
    (state, _, _), kept = jax.lax.scan(act, (state, seen, memory), keys)
    return kept, jnp.mean(state.progress.error) / environment.SCORED_STEPS


def loss(parameters, part):
    x, action, before, value, advantage = part
    mean, now = network.apply(parameters["network"], x)
    ratio = jnp.exp(norm.logpdf(action, mean, jnp.exp(parameters["log_spread"])) - before)
    scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
    # No gain from going further than 0.2 from the policy that acted.
    gain = jnp.minimum(ratio * scaled, jnp.clip(ratio, 0.8, 1.2) * scaled)
    return -gain.mean() + jnp.mean((now - value - advantage) ** 2)


def update(carry, part):
    parameters, opt = carry
    changes, opt = optimiser.update(jax.grad(loss)(parameters, part), opt, parameters)
    return (optax.apply_updates(parameters, changes), opt), None


@jax.jit
def iterate(parameters, opt, key):
    """Collect an episode of each environment and learn from it."""
    roll_key, *keys = jax.random.split(key, EPOCHS + 1)
    (x, action, before, value, reward), error = rollout(parameters, roll_key)
    # Returns end with each breath: from the next one the lung starts at rest.
    breaths = (3, environment.BREATH, ENVIRONMENTS)
    gained = jax.vmap(partial(advantages, discount=0.95, trace=0.9))(
        reward.reshape(breaths), value.reshape(breaths)
    ).reshape(value.shape)
    batch = (x, action, before, value, gained)
    batch = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)
    for key in keys:
        order = jax.random.permutation(key, batch[1].size)
        parts = jax.tree.map(lambda a, o=order: a[o].reshape(PARTS, -1, *a.shape[1:]), batch)
        (parameters, opt), _ = jax.lax.scan(update, (parameters, opt), parts)
    return parameters, opt, error


start = network.init(jax.random.key(0), jnp.zeros(4 * environment.OBSERVATION))
parameters = {"network": start, "log_spread": jnp.asarray(-2.0)}
opt = optimiser.init(parameters)
errors = []
for k in range(ITERATIONS):
    parameters, opt, error = iterate(parameters, opt, jax.random.key(k))
    errors.append(float(error))
    if k % 50 == 0 or k == ITERATIONS - 1:
        mean = sum(errors[-50:]) / len(errors[-50:])  # each iteration has other lungs and cells
        print(f"iteration {k}: mean |pressure - PIP| {mean:.2f} cmH2O while exploring", flush=True)
write_json(Path("runs/train_ppo_jax/errors.json"), errors)
