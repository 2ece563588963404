"""Several trainings side by side in one compiled step, with their learning curves."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import environment, precision, protocol
from ventbench.resume import Checkpoint
from ventbench.training.rl import episodes


class Method(Protocol):
    """Settings of a way of learning: hashable, static in ``jit``; its methods are pure."""

    @property
    def breaths(self) -> int:
        """Episodes in an iteration."""
        ...

    @property
    def iterations(self) -> int:
        """Iterations of a training."""
        ...

    def init(self, key: Array) -> Any:
        """State at the start."""
        ...

    def iterate(self, state: Any, plants: episodes.Lungs) -> Any:
        """State one iteration later."""
        ...

    def policy(self, state: Any) -> Any:
        """The policy learned so far, as a pure controller."""
        ...


#: Cells on each lung by which the best policy of a training is chosen, and the seed they come from.
VALIDATION_CELLS, VALIDATION_SEED = 48, 2021

#: At least this many seconds lie between two checkpoints: what an interruption may cost.
SAVE_SECONDS = 5.0

#: Called with the share that is done and the lowest error of each run, cmH2O, shape ``(R,)``.
Progress = Callable[[float, NDArray[np.float32]], None]


@flax.struct.dataclass
class _Run:
    """One training under way; ``best`` is the policy with the lowest validation error so far."""

    state: Any
    best: Any
    error: Array


@dataclass(frozen=True)
class TrainedPolicies:
    """R finished trainings.

    Attributes:
        policies: the best of each, leaves ``(R, ...)``.
        validation: errors of the policies on fresh cells with noise, cmH2O, ``(R,)``.
        episodes: breaths that a run had seen at each point of its curve, ``(points,)``.
        curves: nominal error of the policy then, cmH2O, ``(R, points)``.
        validation_curves: error of the policy on the fresh cells, cmH2O, ``(R, points)``.
        seconds: computing time of all runs together until each point, without compiling,
            ``(points,)``.
        compile_seconds: time of compiling, which comes first, with the chunk that is run for it, s.
    """

    policies: Any
    validation: NDArray[np.float32]
    episodes: NDArray[np.int64]
    curves: NDArray[np.float32]
    validation_curves: NDArray[np.float32]
    seconds: NDArray[np.float64]
    compile_seconds: float


def nominal_error(lungs: episodes.Lungs, policy: Any) -> Array:
    """Score without noise of a policy on the nominal plants of lungs, cmH2O.

    The mean over lungs and PIPs, without weights; by the version of the protocol that the lungs are
    of.
    """
    count = episodes.lung_count(lungs)
    rigs = isinstance(lungs, episodes.RigLungs)
    pips = np.repeat(np.asarray(protocol.PIPS), count)
    which = jnp.arange(len(pips)) % count
    plants = lungs.nominal if isinstance(lungs, episodes.RigLungs) else lungs
    cells = environment.nominal_scenario(pips)
    if not rigs:  # without noise each breath is the same
        cells = cells.replace(noise=cells.noise[..., :1, :])  # type: ignore[attr-defined]
    each = jax.tree.map(lambda leaf: jnp.asarray(leaf)[which], plants)
    drawn = episodes.Episodes(each, cells, jnp.ones(len(pips)), airway=rigs)
    return jnp.mean(episodes.errors(drawn, policy))


def _fresh_error(lungs: episodes.Lungs, policy: Any) -> Array:
    """Error on fresh cells, weighted as in the training."""
    count = VALIDATION_CELLS * episodes.lung_count(lungs)
    breaths = episodes.breaths_of(isinstance(lungs, episodes.RigLungs))
    key = jax.random.key(VALIDATION_SEED)
    return jnp.mean(episodes.errors(episodes.draw(key, lungs, count, breaths=breaths), policy))


@partial(jax.jit, static_argnames=("method", "count"))
def _advance(method: Method, runs: _Run, plants: episodes.Lungs, count: int) -> tuple[_Run, Array]:
    """``count`` iterations of each run, then both errors, shape ``(R, 2)``."""

    def advance(run: _Run, plant: episodes.Lungs) -> tuple[_Run, Array]:
        def iterate(state: Any, _: None) -> tuple[Any, None]:
            return method.iterate(state, plant), None

        state, _ = jax.lax.scan(iterate, run.state, None, length=count)
        policy = method.policy(state)
        fresh = _fresh_error(plant, policy)
        better = fresh < run.error
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), policy, run.best)
        errors = jnp.stack([nominal_error(plant, policy), fresh])
        return _Run(state, best, jnp.where(better, fresh, run.error)), errors

    return jax.vmap(advance)(runs, plants)


def _start(
    method: Method, seeds: Sequence[int], plants: episodes.Lungs
) -> tuple[_Run, NDArray[np.float32]]:
    numbers = jnp.asarray(np.asarray(seeds, np.uint32))
    keys = jax.vmap(jax.random.key)(numbers)
    states = jax.vmap(method.init)(keys)
    best = jax.vmap(method.policy)(states)
    errors = np.asarray(jax.jit(jax.vmap(nominal_error))(plants, best))
    return _Run(states, best, jnp.full(len(seeds), jnp.inf)), errors


def train(
    method: Method,
    plants: episodes.Lungs,
    seeds: Sequence[int],
    *,
    chunk: int,
    about: str = "",
    file: Path | None = None,
    progress: Progress | None = None,
    save_seconds: float = SAVE_SECONDS,
) -> TrainedPolicies:
    """Train R policies side by side.

    Bit-reproducible on one machine: all random numbers come from the seeds, and an interrupted
    training goes on as if it had not been.

    Args:
        method: the recipe, common to all.
        plants: lungs of each run, an axis ``(R, ...)`` in front of all leaves; taken in float32.
        seeds: one for each run.
        chunk: iterations between two points of the curves.
        about: text that tells one training from another, such as the simulators' hash.
        file: checkpoint that is resumed from and written to; kept at the end.
        progress: see :data:`Progress`.
        save_seconds: least time between two checkpoints, s.

    Raises:
        InputError: if the checkpoint belongs to another training.
        FloatingPointError: if a policy diverges.
    """
    with precision.float32():
        plants = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), plants)
        runs, first = _start(method, seeds, plants)
        points = -(-method.iterations // chunk)
        curves = np.full((len(seeds), points + 1, 2), np.nan, np.float32)
        curves[:, 0, 0] = first
        seconds, compiling = np.zeros(points + 1), np.zeros(())
        carry: Any = (runs, curves, seconds, compiling)
        settings = {
            "method": type(method).__name__,
            "recipe": asdict(method),  # type: ignore[call-overload]
            "seeds": list(map(int, seeds)),
            "chunk": chunk,
            "about": about,
            "jax": jax.__version__,
        }
        stored = Checkpoint(file, settings)
        (runs, curves, seconds, compiling), done = stored.restore(carry)
        began = time.perf_counter()
        if done < points:  # once for nothing, so that no point's time contains the compiling
            jax.block_until_ready(_advance(method, runs, plants, chunk))
        saved = now = time.perf_counter()
        compiling = compiling + (now - began)
        while done < points:
            runs, errors = _advance(method, runs, plants, chunk)
            done += 1
            curves[:, done] = np.asarray(errors)
            before, now = now, time.perf_counter()
            seconds[done] = seconds[done - 1] + now - before
            if not np.isfinite(curves[:, done]).all():
                raise FloatingPointError(f"training diverged before point {done} of {points}")
            if now - saved > save_seconds or done == points:
                stored.save((runs, curves, seconds, compiling), done)
                saved = time.perf_counter()
            if progress is not None:
                progress(done / points, np.asarray(runs.error))
        return TrainedPolicies(
            policies=jax.tree.map(np.asarray, runs.best),
            validation=np.asarray(runs.error),
            episodes=np.arange(points + 1) * chunk * method.breaths,
            curves=curves[..., 0],
            validation_curves=curves[..., 1],
            seconds=seconds,
            compile_seconds=float(compiling),
        )
