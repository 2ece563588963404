"""The ranked task to learn on: breaths of many cells in one scan, or one command at a time.

An episode is a run as it is scored: three breaths of 34 commands, each from rest, on any training
rig of a lung, with deviations drawn anew. The loop is that of scoring,
:func:`ventbench.task.rollouts.control_step`. :func:`roll` runs :class:`Episodes` whole, with the
features of :mod:`ventbench.controllers.residual`; their returns end with the breath. In the
functions of returns, time runs along the leading axis, and no reward comes after the last.

:func:`reset` and :func:`step` are an environment of two pure functions for learners of others. Both
treat one environment; ``jax.vmap`` makes many, and all random numbers of an episode are drawn by
:func:`reset`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base import compilation
from ventbench.base.errors import InputError
from ventbench.controllers import residual
from ventbench.plants.catalog import SimulatorLike
from ventbench.task import environment as env
from ventbench.task import protocol, rollouts
from ventbench.task.draws import random_scenarios
from ventbench.task.environment import Scenario
from ventbench.train.plants import plants_to_train_on

#: Commands of a breath, and of an episode.
BREATH = protocol.INSPIRATION_STEPS
STEPS = protocol.BREATHS * BREATH

#: Commands of a breath that move a scored pressure: all but the last.
MOVES = BREATH - 1

#: Steps of an episode whose pressures are scored.
SCORED_STEPS = len(protocol.SCORED_BREATHS) * BREATH

#: What an observation holds, in order, each of the order of 1: pressure / 40, target / 40, the
#: next ten targets / 40, command before / 50 - 1, time in s, control step / 0.03.
OBSERVATION = 5 + protocol.TARGETS_AHEAD

#: Error that costs a reward of 1, cmH2O.
REWARD_SCALE = 10.0

#: Takes a key, features ``(E, FEATURES)`` and the PID's command, %, ``(E,)``; returns ``u_in``, %,
#: and whatever else of the step :func:`roll` shall return.
Act = Callable[[Array, Array, Array], tuple[Array, Any]]


@flax.struct.dataclass
class Lungs:
    """Lungs to learn on; see :class:`ventbench.train.plants.TrainingPlants`."""

    plants: Any  #: K plants of each of L lungs, the nominal one first, leaves ``(K, L, ...)``.
    weights: Array  #: of the error of each lung at each PIP, ``(L, P)``.

    @property
    def nominal(self) -> Any:
        """The nominal plants, leaves ``(L, ...)``."""
        return jax.tree.map(lambda leaf: leaf[0], self.plants)

    @property
    def count(self) -> int:
        """Number of lungs L."""
        return self.weights.shape[0]


@flax.struct.dataclass
class Episodes:
    """Cells to run, E of them, each with its plant."""

    plants: Any  #: leaves ``(E, ...)``.
    cells: Scenario  #: E cells.
    weight: Array  #: of the errors in each, ``(E,)``.


def draw(
    key: Array, lungs: Lungs, count: int, first: Array | int = 0, vary: bool = True
) -> Episodes:
    """Draw episodes: the lungs in turn, on any of their plants, with new deviations.

    Args:
        key: key of the random numbers.
        lungs: lungs to learn on.
        count: number of episodes E.
        first: which of the six PIPs comes first.
        vary: false for nominal cells on nominal plants.
    """
    number = lungs.count
    lung = jnp.arange(count) % number
    which = jax.tree.leaves(lungs.plants)[0].shape[0]
    plant_key = jax.random.fold_in(key, 1)
    plant = jax.random.randint(plant_key, (count,), 0, which) * vary
    plants = jax.tree.map(lambda leaf: jnp.asarray(leaf)[plant, lung], lungs.plants)
    pip = (first + jnp.arange(count) // number) % len(protocol.PIPS)
    pips = jnp.asarray(protocol.PIPS, jnp.result_type(float))[pip]
    cells = random_scenarios(key, pips, spread=None if vary else 0.0)
    return Episodes(plants, cells, lungs.weights[lung, pip])


def of_iteration(key: Array, lungs: Lungs, breaths: int, iteration: Array) -> Episodes:
    """Draw the episodes of an iteration, three breaths each; the PIPs come in turn."""
    count = breaths // protocol.BREATHS
    return draw(key, lungs, count, iteration * max(count // lungs.count, 1))


def roll(episodes: Episodes, act: Act, key: Array) -> tuple[Array, Any, Array]:
    """Run episodes.

    Args:
        episodes: E of them.
        act: see :data:`Act`; asked :data:`MOVES` times a breath.
        key: split for the steps.

    Returns:
        Of each of the B breaths of all episodes: features before each command, shape
        ``(MOVES, B, features)``; what ``act`` kept; rewards, minus the weighted error after each
        command over ``REWARD_SCALE``, shape ``(MOVES, B)``.
    """
    cells, weight = episodes.cells, episodes.weight
    memory = residual.init_features(cells.pip.shape)

    def policy(state: Any, observation: Any, key: Array) -> tuple[Any, Array]:
        memory, x, base = residual.features(state[0], observation)
        command, extra = act(key, x, base)
        return (memory, (x, extra)), command

    def run(memory: Any, now: tuple[Array, Array]) -> tuple[Any, Any]:
        breath, keys = now
        varied = env.vary(episodes.plants, cells, breath)

        def step(carry: Any, now: tuple[Array, Array]) -> tuple[Any, tuple[Array, Any, Array]]:
            loop, memory = carry
            (loop, (memory, (x, extra))), pressure = rollouts.control_step(
                varied,
                cells,
                policy,
                lambda _, after, *__: after.signals.scored,
                (loop, (memory, None)),
                (breath, *now),
            )
            reward = -weight * jnp.abs(pressure - cells.pip) / REWARD_SCALE
            return (loop, memory), (x, extra, reward)

        start = env.start_breath(varied, cells)
        (loop, memory), out = jax.lax.scan(step, (start, memory), (jnp.arange(MOVES), keys))
        # The last observation is remembered too.
        memory, _, _ = residual.features(memory, env.observe(cells, loop, breath, MOVES))
        return memory, out

    keys = jax.random.split(key, (protocol.BREATHS, MOVES))
    breaths = jnp.arange(protocol.BREATHS)
    _, out = jax.lax.scan(run, memory, (breaths, keys))
    # (breath, step, episode, ...) -> (step, breath and episode, ...)
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1).reshape(MOVES, -1, *x.shape[3:]), out)


@jax.jit
def errors(episodes: Episodes, controller: Any) -> Array:
    """Mean weighted ``|pressure - PIP|`` of each episode, cmH2O, shape ``(E,)``.

    The breaths that are scored count.

    Args:
        episodes: E of them.
        controller: pure controller.
    """
    run, _ = rollouts.closed_loop(episodes.plants, controller, episodes.cells)
    error = jnp.abs(run.pressure - episodes.cells.pip[..., None, None])
    return error[..., protocol.SCORED_BREATHS, :].mean(axis=(-2, -1)) * episodes.weight


def discounted(rewards: Array, discount: float) -> Array:
    """Sum of the rewards from each step on, discounted; shape of ``rewards``, ``(T, ...)``."""

    def back(after: Array, reward: Array) -> tuple[Array, Array]:
        total = reward + discount * after
        return total, total

    _, out = jax.lax.scan(back, jnp.zeros_like(rewards[0]), rewards, reverse=True)
    return out


def advantages(rewards: Array, values: Array, discount: float, trace: float) -> Array:
    """Generalised advantage estimates of an episode that ends after its last reward.

    Args:
        rewards: rewards after each command, shape ``(T, ...)``.
        values: estimated before each command, shape ``(T, ...)``.
        discount: factor of a reward one step later.
        trace: lambda, 0 for one-step differences, 1 for returns minus values.

    Returns:
        Shape ``(T, ...)``.
    """
    following = jnp.concatenate([values[1:], jnp.zeros_like(values[:1])])
    return discounted(rewards + discount * following - values, discount * trace)


@flax.struct.dataclass
class Episode:
    """What stays the same in an episode."""

    plant: Any  #: of the rig, without the deviations of the cell.
    cell: Scenario  #: PIP, deviations and noise, hidden from the controller.
    weight: Array  #: of errors, see :class:`ventbench.train.plants.TrainingPlants`.


@flax.struct.dataclass
class Progress:
    """What a command changes."""

    loop: env.LoopState  #: state of the breath.
    error: Array  #: sum of ``|pressure - PIP|`` over the scored steps so far, cmH2O.


@flax.struct.dataclass
class State:
    """One environment in mid-episode."""

    episode: Episode  #: what stays the same.
    progress: Progress  #: what changes.
    count: Array  #: commands so far.


def load_lungs(
    simulator: SimulatorLike = "frozen", *, rigs: Literal["training", "reference"]
) -> Lungs:
    """Load lungs to learn on, in float32.

    Args:
        simulator: see :func:`ventbench.load_simulators`.
        rigs: ``"training"`` for all members of all training rigs of each lung, the population that
            ranked draws are from; ``"reference"`` for the rig of the nominal score.

    Raises:
        InputError: if there are no such simulators or rigs, or they have no plants.
    """
    chosen = {"training": slice(None), "reference": slice(1)}
    if rigs not in chosen:
        raise InputError(f"rigs is {rigs!r}; choose training or reference")
    trained_on = plants_to_train_on(simulator)
    with compilation.float32():
        plants = jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf)[chosen[rigs]], jnp.float32), trained_on.plants
        )
        return Lungs(plants, jnp.asarray(trained_on.weights, jnp.float32))


def reset(
    key: Array,
    lungs: Lungs,
    lung: Array | int | None = None,
    pip: Array | float | None = None,
    *,
    vary: bool = True,
) -> tuple[State, Array]:
    """Begin an episode.

    Args:
        key: of all random numbers of the episode.
        lungs: to learn on, from :func:`load_lungs`.
        lung: index of the lung; any if not given.
        pip: nominal PIP, cmH2O; one of the protocol's if not given. The weight of the errors is
            that of the nearest one.
        vary: false for nominal cells on any of the plants.

    Returns:
        The state, and the first observation, shape ``(OBSERVATION,)``.
    """
    keys = jax.random.split(key, 4)
    pips = jnp.asarray(protocol.PIPS, jnp.float32)
    rigs = jax.tree.leaves(lungs.plants)[0].shape[0]
    lung = jax.random.randint(keys[0], (), 0, lungs.count) if lung is None else lung
    pip = jax.random.choice(keys[1], pips) if pip is None else jnp.asarray(pip)
    rig = jax.random.randint(keys[2], (), 0, rigs) * vary
    plant = jax.tree.map(lambda leaf: jnp.asarray(leaf)[rig, lung], lungs.plants)
    cells = random_scenarios(keys[3], pip[None], spread=None if vary else 0.0)
    cell = jax.tree.map(lambda leaf: leaf[0], cells)
    varied = env.vary(plant, cell, 0)
    weight = lungs.weights[lung, jnp.argmin(jnp.abs(pips - pip))]
    progress = Progress(env.start_breath(varied, cell), jnp.zeros_like(cell.pip))
    state = State(Episode(plant, cell, weight), progress, jnp.zeros((), jnp.int32))
    return state, observe(state)


def observe(state: State) -> Array:
    """What a submission sees, scaled, shape ``(OBSERVATION,)``; see :data:`OBSERVATION`."""
    count = jnp.minimum(state.count, STEPS - 1)  # after the end, an observation of the same kind
    sample = env.observe(state.episode.cell, state.progress.loop, count // BREATH, count % BREATH)
    after = [sample.previous_u_in / 50.0 - 1.0, sample.time, sample.dt / protocol.DT]
    pressures = jnp.stack([sample.pressure, sample.target]) / 40.0
    return jnp.concatenate([pressures, sample.targets_ahead / 40.0, jnp.stack(after)])


def step(state: State, action: Array) -> tuple[State, Array, Array, Array]:
    """Apply a command.

    The last command of a breath moves no pressure that is scored: its reward is 0, and what is
    seen next is the lung at rest before the next breath.

    Args:
        state: from :func:`reset` or this function.
        action: -1..1, shape ``()``: ``u_in`` is ``50 + 50 action``, %, clipped to 0..100.

    Returns:
        The next state; its observation; the reward, minus the weighted error that follows, cmH2O,
        over 10; and whether the episode has ended, by which time ``state.progress.error`` over
        :data:`SCORED_STEPS` is the error as it is scored.
    """
    episode, count = state.episode, state.count
    breath, index = count // BREATH, count % BREATH

    def pressures(before: env.LoopState, after: env.LoopState, *_: Array) -> tuple[Array, Array]:
        return before.signals.scored, after.signals.scored

    varied = env.vary(episode.plant, episode.cell, breath)
    (loop, _), (before, after) = rollouts.control_step(
        varied,
        episode.cell,
        rollouts.commanded,
        pressures,
        (state.progress.loop, None),
        (breath, index, 50.0 + 50.0 * action),
    )
    last = index == BREATH - 1
    reward = -episode.weight * jnp.abs(after - episode.cell.pip) / REWARD_SCALE
    scored = breath >= min(protocol.SCORED_BREATHS)
    error = state.progress.error + scored * jnp.abs(before - episode.cell.pip)
    following = jnp.minimum((count + 1) // BREATH, protocol.BREATHS - 1)

    def rest() -> env.LoopState:
        return env.start_breath(env.vary(episode.plant, episode.cell, following), episode.cell)

    # A branch, not a selection: the compiler then finishes the step before it is observed, and does
    # not repeat the lung's equations in each thing that is made of it, which takes twice as long.
    loop = jax.lax.cond(last, rest, lambda: loop)
    state = State(episode, Progress(loop, error), count + 1)
    return state, observe(state), jnp.where(last, 0.0, reward), state.count == STEPS
