"""``ventbench/Ventilator-v1``: the ranked task as a Gymnasium environment, alone or many at once.

Importing this module registers it; so does Gymnasium itself, ``gymnasium.make`` and
``gymnasium.make_vec`` by the name ``"ventbench.gym_env:ventbench/Ventilator-v1"``. The task is that
of :mod:`ventbench.train.rl.environment`. Needs the extra ``ventbench[gym]``.
"""

# ruff: noqa: E402  # a missing package is named before its import fails

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, ClassVar, Literal

from ventbench.base.errors import InputError, require

require("gymnasium", extra="gym", what="environments")

import gymnasium
import gymnasium.vector
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from jax import Array
from numpy.typing import NDArray

from ventbench.base import compilation
from ventbench.plants.catalog import SimulatorLike
from ventbench.task import protocol
from ventbench.task.lungs import lung as parse_lung
from ventbench.train.plants import plants_to_train_on
from ventbench.train.rl import environment
from ventbench.train.rl.environment import STEPS, Lungs

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class _Layout:
    """Where the leaves of E trees lie in one array, so that a compiled step has few arguments.

    A row a number and a column a tree, so that every operation runs over contiguous vectors.
    """

    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, tree: Any) -> _Layout:
        """Layout of trees like one of arrays, or of their shapes."""
        leaves, structure = jax.tree.flatten(tree)
        return cls(structure, tuple(leaf.shape for leaf in leaves))

    def unpack(self, rows: Array) -> Any:
        """Trees with leaves ``(..., E)`` of what :func:`_pack` made."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])
        parts = zip(jnp.split(rows, ends[:-1]), self.shapes, strict=True)
        leaves = [part.reshape(*shape, rows.shape[-1]) for part, shape in parts]
        return jax.tree.unflatten(self.structure, leaves)


def _pack(trees: Any) -> Array:
    """Rows of trees with leaves ``(..., E)``."""
    return jnp.concatenate([x.reshape(-1, x.shape[-1]) for x in jax.tree.leaves(trees)])


def _split_noise(episode: environment.Episode) -> tuple[environment.Episode, Array]:
    """What stays the same in an episode but for its noise, and the noise.

    A step reads one row of the noise: packed with the rest, all of it would be copied.
    """
    cell = episode.cell
    rest = cell.replace(noise=cell.noise[:0])  # type: ignore[attr-defined]
    return episode.replace(cell=rest), cell.noise  # type: ignore[attr-defined]


@partial(jax.jit, static_argnames="vary")
def _reset(
    seed: Array, lungs: Lungs, lung: Array, pip: Array, *, vary: bool
) -> tuple[tuple[Array, Array], Array, Array, Array]:
    """Begin E episodes.

    Returns:
        What stays the same in them, packed, and their noise; what changes, packed; PIPs, cmH2O;
        observations.
    """
    keys = jax.random.split(jax.random.key(seed), lung.shape[0])
    reset = partial(environment.reset, lungs=lungs, vary=vary)
    states, observation = jax.vmap(
        lambda key, lung, pip: reset(key, lung=lung, pip=pip), out_axes=-1
    )(keys, lung, pip)
    rest, noise = _split_noise(states.episode)
    return (_pack(rest), noise), _pack(states.progress), states.episode.cell.pip, observation.T


@lru_cache
def _program(fixed: _Layout, changing: _Layout) -> Callable[..., tuple[Array, Array, Array]]:
    """Compile the step of packed environments.

    It takes what stays the same and the noise, of :func:`_reset`; what changes and the count of
    steps, which it overwrites; and actions, ``(E, 1)``. It returns the latter two one step later,
    and one array of what is seen: the rows of the observation, then those of :data:`_FURTHER`.
    """

    def advance(
        episode: environment.Episode, progress: environment.Progress, count: Array, action: Array
    ) -> tuple[environment.Progress, Array]:
        state = environment.State(episode, progress, count)
        state, observation, reward, _ = environment.step(state, action)
        after = state.progress
        further = jnp.stack([reward, after.loop.signals.scored, after.error])
        return after, jnp.concatenate([observation, further])

    def step(
        constant: tuple[Array, Array], progress: Array, count: Array, actions: Array
    ) -> tuple[Array, Array, Array]:
        rest = fixed.unpack(constant[0])
        episodes = rest.replace(cell=rest.cell.replace(noise=constant[1]))
        axes = (-1, -1, None, -1)
        states = (episodes, changing.unpack(progress), count, actions.reshape(-1))
        after, observation = jax.vmap(advance, in_axes=axes, out_axes=-1)(*states)
        return _pack(after), count + 1, observation

    return jax.jit(step, donate_argnums=(1, 2))


#: Rows of what a step shows after those of the observation.
_FURTHER = _REWARD, _PRESSURE, _ERROR = tuple(environment.OBSERVATION + k for k in range(3))


class VentilatorVector(gymnasium.vector.VectorEnv[Floats, Floats, Floats]):
    """Many ventilators at once, each step one compiled call.

    An episode is a run as it is scored: three breaths of 34 commands, on any training rig of the
    lung, with hidden deviations drawn anew. All episodes end together. The call of ``step`` after
    the end ignores its actions and begins new ones, with reward 0 (``AutoresetMode.NEXT_STEP``).

    Action: ``u_in`` as ``50 + 50 a``, %, with ``a`` in -1..1. Reward: minus the absolute error that
    follows, cmH2O, over 10, with the weight of the lung and PIP in the ranked score. ``info`` holds
    ``lung`` and ``pip`` at the start of episodes and ``error`` at their end: the mean absolute
    error as the score counts it, cmH2O.

    Args:
        num_envs: number of ventilators E.
        lung: id of the lung; all in turn if not given.
        pip: peak pressure, cmH2O; the six of the protocol in turn if not given.
        rigs: ``"training"``, the population of the ranked draws; or ``"reference"``, the rig of the
            nominal score.
        noise: deviations and sensor noise drawn anew from the distributions of the scored draws;
            else nominal breaths on the reference rig.
        simulator: see :func:`ventbench.load_simulators`.

    Raises:
        InputError: if there is no such lung, the PIP is outside 5..60 cmH2O, or E is below 1.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": [],
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        lung: str | None = None,
        pip: float | None = None,
        rigs: Literal["training", "reference"] = "training",
        noise: bool = True,
        simulator: SimulatorLike = "frozen",
    ):
        if num_envs < 1:
            raise InputError(f"num_envs is {num_envs}; it must be at least 1")
        if pip is not None and not protocol.PEEP < pip <= protocol.SAFETY_PRESSURE:
            raise InputError(f"PIP {pip:g} cmH2O is outside of 5..60 cmH2O")
        self.num_envs = num_envs
        self.single_action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        limit = np.full(environment.OBSERVATION, 5.0, np.float32)
        self.single_observation_space = spaces.Box(-limit, limit, dtype=np.float32)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        lung_names = self.lungs = plants_to_train_on(simulator).names
        if lung is not None and parse_lung(lung).id not in lung_names:
            raise InputError(f"{lung} is not a lung of the simulators: {', '.join(lung_names)}")
        chosen = range(len(lung_names)) if lung is None else [lung_names.index(parse_lung(lung).id)]
        self._lung = np.resize(np.array(chosen), num_envs)
        self._names = np.array(lung_names, object)[self._lung]
        # Each lung gets each PIP before the first PIP comes again.
        turn = np.arange(num_envs) // len(chosen) % len(protocol.PIPS)
        pips = np.asarray(protocol.PIPS, np.float32)[turn]
        self._pips = pips if pip is None else np.full(num_envs, pip, np.float32)
        self._turn = len(chosen)
        self._rigs, self._noise = environment.load_lungs(simulator, rigs=rigs), noise
        with compilation.float32():
            state, _ = jax.eval_shape(environment.reset, jax.random.key(0), self._rigs)
            rest, _ = jax.eval_shape(_split_noise, state.episode)
        self._advance = _program(_Layout.of(rest), _Layout.of(state.progress))
        self._count = STEPS + 1

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode in each; one seed for all, and no options are known."""
        super().reset(seed=seed)
        # PIPs change lungs from episode to episode.
        shift = int(self.np_random.integers(len(protocol.PIPS))) * self._turn
        number = np.uint32(self.np_random.integers(2**32))
        with compilation.float32():
            self._constant, self._progress, pip, observation = _reset(
                number, self._rigs, self._lung, np.roll(self._pips, shift), vary=self._noise
            )
            self._steps = jnp.zeros((), jnp.int32)
        self._count = 0
        everywhere = np.ones(self.num_envs, bool)
        info = {"lung": self._names, "pip": np.asarray(pip)}
        return np.array(observation), info | {f"_{name}": everywhere for name in info}

    def step(
        self, actions: Floats
    ) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Apply a command to each; see :meth:`gymnasium.vector.VectorEnv.step`.

        Args:
            actions: shape ``(E, 1)``.

        Raises:
            InputError: if no episode is under way, or an action is not finite.
        """
        if self._count > STEPS:
            raise InputError("no episode is under way: call reset() first")
        nothing = np.zeros(self.num_envs, bool)
        if self._count == STEPS:
            observation, info = self.reset()
            return observation, np.zeros(self.num_envs, np.float32), nothing, nothing.copy(), info
        values = np.asarray(actions, np.float32)
        if not math.isfinite(values.sum()):
            at = int(np.argmin(np.isfinite(values.reshape(self.num_envs))))
            raise InputError(f"action {at} is {values[at, 0]}; it must be a number from -1 to 1")
        with compilation.float32():
            self._progress, self._steps, packed = self._advance(
                self._constant, self._progress, self._steps, values
            )
        self._count += 1
        rows = np.asarray(packed)
        self.pressure = rows[_PRESSURE]
        terminated, info = np.full(self.num_envs, self._count == STEPS), {}
        if self._count == STEPS:
            info = {"error": rows[_ERROR] / environment.SCORED_STEPS, "_error": terminated}
        # Copies, which may be written to, as learners expect.
        observation = np.array(rows[: environment.OBSERVATION].T, order="C")
        return observation, rows[_REWARD].copy(), terminated, nothing, info


class Ventilator(gymnasium.Env[Floats, Floats]):
    """One ventilator of :class:`VentilatorVector`.

    ``info`` holds ``lung``, ``pip``, the true airway ``pressure``, cmH2O, and at the end ``error``.

    Args:
        lung: id of the lung; any for each episode if not given.
        pip: peak pressure, cmH2O; one of the six at random if not given.
        rigs: as of :class:`VentilatorVector`.
        noise: as of :class:`VentilatorVector`.
        simulator: see :func:`ventbench.load_simulators`.

    Raises:
        InputError: if there is no such lung, or the PIP is outside 5..60 cmH2O.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(
        self,
        lung: str | None = None,
        pip: float | None = None,
        rigs: Literal["training", "reference"] = "training",
        noise: bool = True,
        simulator: SimulatorLike = "frozen",
    ):
        self._vector = VentilatorVector(1, lung, pip, rigs, noise, simulator)
        self._any = () if lung is not None else self._vector.lungs
        self._fixed = pip is not None
        self.action_space = self._vector.single_action_space
        self.observation_space = self._vector.single_observation_space
        self._info: dict[str, Any] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode; see :meth:`gymnasium.Env.reset`. No options are known."""
        super().reset(seed=seed)
        vector, draw = self._vector, self.np_random
        if self._any:
            at = int(draw.integers(len(self._any)))
            vector._lung, vector._names = np.array([at]), np.array([self._any[at]], object)
        if not self._fixed:
            vector._pips = draw.choice(np.asarray(protocol.PIPS, np.float32), 1)
        observation, info = vector.reset(seed=int(draw.integers(2**31)))
        self._info = {"lung": str(info["lung"][0]), "pip": float(info["pip"][0])}
        return observation[0], {**self._info, "pressure": 40.0 * float(observation[0, 0])}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Apply a command; see :meth:`gymnasium.Env.step`.

        Raises:
            InputError: if no episode is under way, or the action is not finite.
        """
        if self._vector._count >= STEPS:
            raise InputError("no episode is under way: call reset() first")
        observation, reward, terminated, _, last = self._vector.step(
            np.asarray(action, np.float32).reshape(1, 1)
        )
        info = {**self._info, "pressure": float(self._vector.pressure[0])}
        if terminated[0]:
            info["error"] = float(last["error"][0])
        return observation[0], float(reward[0]), bool(terminated[0]), False, info


def register() -> None:
    """Make the environment known to Gymnasium, once."""
    if "ventbench/Ventilator-v1" not in gymnasium.registry:
        gymnasium.register(
            "ventbench/Ventilator-v1",
            "ventbench.gym_env:Ventilator",
            vector_entry_point="ventbench.gym_env:VentilatorVector",
        )


register()
