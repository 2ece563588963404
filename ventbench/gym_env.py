"""``ventbench/Ventilator-v1``: the benchmark as a Gymnasium environment, one breath an episode.

Importing this module registers it; so does Gymnasium itself, ``gymnasium.make`` and
``gymnasium.make_vec`` by the name ``"ventbench.gym_env:ventbench/Ventilator-v1"``. Needs the extra
``ventbench[gym]``.
"""

# ruff: noqa: E402  # a missing package is named before its import fails

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

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

from ventbench.base import precision
from ventbench.plants import frozen
from ventbench.task import environment as env
from ventbench.task import protocol
from ventbench.task.draws import random_scenarios
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant
from ventbench.task.lungs import LUNG_IDS, scored_lung
from ventbench.train.rl import episodes

#: What an observation holds, in order, each of the order of 1: pressure / 40, target / 40, the
#: next ten targets / 40, command before / 50 - 1, time in s, control step / 0.03.
OBSERVATION = 5 + protocol.TARGETS_AHEAD

Floats = NDArray[np.float32]


@jax.jit
def _start(plant: Plant, cell: Scenario) -> tuple[env.LoopState, Array]:
    loop = env.start_breath(env.vary(plant, cell), cell)
    return loop, _seen(cell, loop, 0)


@jax.jit
def _step(
    plant: Plant, cell: Scenario, loop: env.LoopState, u_in: Array, step: Array
) -> tuple[env.LoopState, Array, Array]:
    """State one step later, what is seen then, and the airway pressure, cmH2O."""
    varied = env.vary(plant, cell)
    loop, _ = env.inspire(varied, cell, loop, u_in)
    # The target holds to the last step; the observation after it is of the same kind.
    after = jnp.minimum(step + 1, protocol.INSPIRATION_STEPS - 1)
    return loop, _seen(cell, loop, after), loop.signals.scored


@partial(jax.jit, static_argnames="vary")
def _cell(key: Array, pip: Array, vary: bool) -> Scenario:
    cells = episodes.sample(key, 1, first=pip, vary=vary, breaths=1)
    return jax.tree.map(lambda leaf: leaf[0], cells)


@partial(jax.jit, static_argnames="vary")
def _cells(key: Array, pips: Array, vary: bool) -> Scenario:
    return random_scenarios(key, pips, spread=None if vary else 0.0, breaths=1)


def _seen(cell: Scenario, loop: env.LoopState, step: Array | int) -> Array:
    seen = env.observe(cell, loop, 0, step)
    values = [
        seen.pressure / 40.0,
        seen.target / 40.0,
        *(seen.targets_ahead[..., k] / 40.0 for k in range(protocol.TARGETS_AHEAD)),
        seen.previous_u_in / 50.0 - 1.0,
        seen.time,
        seen.dt / protocol.DT,
    ]
    return jnp.stack([jnp.asarray(value, jnp.float32) for value in values], axis=-1)


class Ventilator(gymnasium.Env[Floats, Floats]):
    """One inspiration from rest: 33 commands that move the pressure that is scored.

    Action: ``u_in`` as ``50 + 50 a``, %, with ``a`` in -1..1. Reward: minus the absolute error
    that follows, cmH2O, over 10. ``info`` holds ``lung``, ``pip``, ``pressure`` (true) and, at the
    end, ``error``: the mean absolute error of the breath as the score counts it, cmH2O.

    Args:
        lung: id of the lung; a lung at random for each breath if not given.
        pip: peak pressure, cmH2O; one of the six at random if not given.
        noise: deviations and sensor noise drawn anew from the distributions of the scored draws;
            else nominal breaths.
        render_mode: must be None.

    Raises:
        InputError: if there is no such lung, or the PIP is outside 6..60 cmH2O.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(
        self,
        lung: str | None = None,
        pip: float | None = None,
        noise: bool = True,
        render_mode: str | None = None,
    ):
        if render_mode is not None:
            raise InputError("this environment draws nothing; leave render_mode out")
        if pip is not None and not protocol.PEEP < pip <= protocol.SAFETY_PRESSURE:
            raise InputError(f"PIP {pip:g} cmH2O is outside of 5..60 cmH2O")
        self.render_mode = None
        self._lungs = LUNG_IDS if lung is None else (scored_lung(lung).id,)
        self._pip, self._noise = pip, noise
        with precision.float32():
            plants = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), frozen.load().plants)
            self._plants = [jax.tree.map(lambda x, i=i: x[i], plants) for i in range(len(LUNG_IDS))]
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        low, high = np.full(OBSERVATION, -5.0, np.float32), np.full(OBSERVATION, 5.0, np.float32)
        self.observation_space = spaces.Box(low, high, dtype=np.float32)
        self._loop: env.LoopState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin a breath; see :meth:`gymnasium.Env.reset`. No options are known."""
        super().reset(seed=seed)
        self._lung = self._lungs[int(self.np_random.integers(len(self._lungs)))]
        which, number = self.np_random.integers([len(protocol.PIPS), 2**32])
        with precision.float32():
            key = jax.random.key(jnp.asarray(number, jnp.uint32))
            cell = _cell(key, jnp.asarray(which), self._noise)
            if self._pip is not None:
                shift = cell.pip - jnp.asarray(protocol.PIPS, jnp.float32)[int(which)]
                cell = cell.replace(pip=self._pip + shift)  # type: ignore[attr-defined]
            self._cell: Scenario = cell
            self._plant = self._plants[LUNG_IDS.index(self._lung)]
            self._loop, seen = _start(self._plant, cell)
        self._count = 0
        self._pressure = float(cell.start)
        self._total = abs(self._pressure - float(cell.pip))
        return np.asarray(seen), self._info()

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Apply a command; see :meth:`gymnasium.Env.step`.

        Raises:
            InputError: if no breath is under way, or the action is not finite.
        """
        if self._loop is None or self._count >= episodes.STEPS:
            raise InputError("no breath is under way: call reset() first")
        value = float(np.asarray(action, np.float32).reshape(-1)[0])
        if not np.isfinite(value):
            raise InputError(f"the action is {value}; it must be a number from -1 to 1")
        with precision.float32():
            u_in, step = jnp.asarray(50.0 + 50.0 * value), jnp.asarray(self._count)
            self._loop, seen, pressure = _step(self._plant, self._cell, self._loop, u_in, step)
        self._pressure = float(pressure)
        error = abs(self._pressure - float(self._cell.pip))
        self._count += 1
        self._total += error
        ended = self._count == episodes.STEPS
        info = self._info()
        if ended:
            info["error"] = self._total / protocol.INSPIRATION_STEPS
        return np.asarray(seen), -error / episodes.REWARD_SCALE, ended, False, info

    def _info(self) -> dict[str, Any]:
        return {"lung": self._lung, "pip": float(self._cell.pip), "pressure": self._pressure}


class VentilatorVector(gymnasium.vector.VectorEnv[Floats, Floats, NDArray[np.float64]]):
    """Many ventilators at once, each step compiled: what :class:`Ventilator` does, batched.

    Every breath has 33 commands, so that all end together. The call of ``step`` after the end
    ignores its actions and begins new breaths, with reward 0 (``AutoresetMode.NEXT_STEP``).

    Args:
        num_envs: number of ventilators E.
        lung: id of the lung; the six in turn if not given.
        pip: peak pressure, cmH2O; the six of the protocol in turn if not given.
        noise: as of :class:`Ventilator`.
        render_mode: must be None.

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
        noise: bool = True,
        render_mode: str | None = None,
    ):
        if num_envs < 1:
            raise InputError(f"num_envs is {num_envs}; it must be at least 1")
        single = Ventilator(lung, pip, noise, render_mode)
        self.num_envs, self.render_mode = num_envs, None
        self.single_action_space = single.action_space
        self.single_observation_space = single.observation_space
        self.action_space = batch_space(single.action_space, num_envs)
        self.observation_space = batch_space(single.observation_space, num_envs)
        lungs = [LUNG_IDS.index(name) for name in single._lungs]
        self._lungs = [LUNG_IDS[i] for i in np.resize(lungs, num_envs)]
        # Each lung gets each PIP before the first PIP comes again.
        turn = np.arange(num_envs) // len(lungs) % len(protocol.PIPS)
        self._pips = np.asarray(protocol.PIPS)[turn] if pip is None else np.full(num_envs, pip)
        self._noise = noise
        with precision.float32():
            plants = jax.tree.map(
                lambda *leaf: jnp.stack(leaf), *(single._plants[i] for i in lungs)
            )
            which = jnp.arange(num_envs) % len(lungs)
            self._plants = jax.tree.map(lambda leaf: jnp.asarray(leaf)[which], plants)
        self._loop: env.LoopState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin a breath in each; one seed for all, and no options are known."""
        super().reset(seed=seed)
        # PIPs change lungs from breath to breath.
        shift = int(self.np_random.integers(len(protocol.PIPS))) * len(set(self._lungs))
        with precision.float32():
            key = jax.random.key(jnp.asarray(self.np_random.integers(2**32), jnp.uint32))
            pips = jnp.asarray(np.roll(self._pips, shift), jnp.float32)
            self._cells = _cells(key, pips, self._noise)
            loop, seen = _start(self._plants, self._cells)
        self._loop, self._count = loop, 0
        self._pressure = np.asarray(loop.signals.scored, float)
        self._total = np.abs(self._pressure - np.asarray(self._cells.pip, float))
        return np.asarray(seen), self._info()

    def step(
        self, actions: Floats
    ) -> tuple[Floats, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Apply a command to each; see :meth:`gymnasium.vector.VectorEnv.step`.

        Args:
            actions: shape ``(E, 1)``.

        Raises:
            InputError: if no breath is under way, or an action is not finite.
        """
        if self._loop is None:
            raise InputError("no breath is under way: call reset() first")
        nothing = np.zeros(self.num_envs, bool)
        if self._count == episodes.STEPS:
            seen, info = self.reset()
            return seen, np.zeros(self.num_envs), nothing, nothing.copy(), info
        values = np.asarray(actions, np.float32).reshape(self.num_envs)
        if not np.isfinite(values).all():
            at = int(np.argmin(np.isfinite(values)))
            raise InputError(f"action {at} is {values[at]}; it must be a number from -1 to 1")
        with precision.float32():
            u_in, step = jnp.asarray(50.0 + 50.0 * values), jnp.asarray(self._count)
            self._loop, seen, pressure = _step(self._plants, self._cells, self._loop, u_in, step)
        self._count += 1
        self._pressure = np.asarray(pressure, float)
        errors = np.abs(self._pressure - np.asarray(self._cells.pip, float))
        self._total += errors
        ended = np.full(self.num_envs, self._count == episodes.STEPS)
        info = self._info()
        if ended[0]:
            info |= {"error": self._total / protocol.INSPIRATION_STEPS, "_error": ended.copy()}
        return np.asarray(seen), -errors / episodes.REWARD_SCALE, ended, nothing, info

    def _info(self) -> dict[str, Any]:
        values = {
            "lung": np.array(self._lungs, object),
            "pip": np.asarray(self._cells.pip, float),
            "pressure": self._pressure,
        }
        return values | {f"_{name}": np.ones(self.num_envs, bool) for name in values}


def register() -> None:
    """Make the environment known to Gymnasium, once."""
    if "ventbench/Ventilator-v1" not in gymnasium.registry:
        gymnasium.register(
            "ventbench/Ventilator-v1",
            "ventbench.gym_env:Ventilator",
            vector_entry_point="ventbench.gym_env:VentilatorVector",
        )


register()
