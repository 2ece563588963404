"""Networks for the lungs by a method of reinforcement learning: trainings, weights, a report.

:func:`train` runs several trainings side by side in one compiled step, with their learning curves;
:func:`train_networks` makes what an entry needs, and :func:`command` does so from a command line.
The methods themselves stand beside their entries: ``submissions/ppo/train.py`` and
``submissions/dqn/train.py``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench.base import compilation, files
from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.base.resume import Checkpoint, fingerprint
from ventbench.controllers import residual
from ventbench.controllers.pid import PID
from ventbench.plants.catalog import SimulatorLike
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.train.plants import (
    ALL,
    TrainedControllers,
    TrainingPlants,
    check_names,
    plants_to_train_on,
)
from ventbench.train.rl import environment


@flax.struct.dataclass
class State:
    """One training: parameters, the optimiser's state, key, number of the iteration."""

    parameters: Any  #: of the network; for PPO of both networks and the spread, by name.
    optimiser: Any
    key: Array
    iteration: Array


class Method(Protocol):
    """Settings of a way of learning: a frozen dataclass, static in ``jit``, of pure methods."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def breaths(self) -> int:
        """Breaths of an iteration, three an episode."""
        ...

    @property
    def iterations(self) -> int:
        """Iterations of a training."""
        ...

    def init(self, key: Array) -> Any:
        """State at the start of a training."""

    def iterate(self, state: Any, plants: environment.Lungs) -> Any:
        """State after one more iteration on lungs."""

    def policy(self, state: Any) -> Any:
        """Policy learned so far."""


#: Cells on each lung by which the best policy of a training is chosen, and the seed they come from.
VALIDATION_CELLS, VALIDATION_SEED = 48, 2021

#: Time between two checkpoints, s.
SAVE_SECONDS = 5.0

#: Called with the share that is done and the lowest error of each run, cmH2O, shape ``(R,)``.
RunsProgress = Callable[[float, NDArray[np.float32]], None]


@flax.struct.dataclass
class _Run:
    """One training under way; ``best`` is the policy with the lowest validation error so far."""

    state: Any
    best: Any
    error: Array


@dataclass(frozen=True)
class TrainedPolicies:
    """R finished trainings."""

    policies: Any  #: the best of each, leaves ``(R, ...)``.
    #: errors of the policies on fresh cells with noise, cmH2O, ``(R,)``.
    validation: NDArray[np.float32]
    episodes: Ints  #: breaths that a run had seen at each point of its curve, ``(points,)``.
    curves: NDArray[np.float32]  #: nominal error of the policy then, cmH2O, ``(R, points)``.
    #: computing time of all runs together until each point, without compiling, ``(points,)``.
    seconds: Floats
    #: time of compiling, which comes first, with the chunk that is run for it, s.
    compile_seconds: float


def nominal_error(lungs: environment.Lungs, policy: Any) -> Array:
    """Score without noise of a policy on the nominal plants of lungs, cmH2O.

    The mean over lungs and PIPs, without weights.
    """
    pips = np.repeat(np.asarray(protocol.PIPS), lungs.count)
    lung_of_cell = jnp.arange(len(pips)) % lungs.count
    cells = nominal_scenario(pips)
    plants = jax.tree.map(lambda leaf: jnp.asarray(leaf)[lung_of_cell], lungs.nominal)
    episodes = environment.Episodes(plants, cells, jnp.ones(len(pips)))
    return jnp.mean(environment.errors(episodes, policy))


def fresh_error(lungs: environment.Lungs, policy: Any) -> Array:
    """Error of a policy on fresh cells of its lungs, weighted as in the training, cmH2O."""
    count = VALIDATION_CELLS * lungs.count
    key = jax.random.key(VALIDATION_SEED)
    return jnp.mean(environment.errors(environment.draw(key, lungs, count), policy))


@partial(jax.jit, static_argnames=("method", "count"))
def _advance(
    method: Method, runs: _Run, plants: environment.Lungs, count: int
) -> tuple[_Run, Array]:
    """``count`` iterations of each run, then the nominal errors, shape ``(R,)``."""

    def advance(run: _Run, plant: environment.Lungs) -> tuple[_Run, Array]:
        def iterate(state: Any, _: None) -> tuple[Any, None]:
            return method.iterate(state, plant), None

        state, _ = jax.lax.scan(iterate, run.state, None, length=count)
        policy = method.policy(state)
        fresh = fresh_error(plant, policy)
        better = fresh < run.error
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), policy, run.best)
        return _Run(state, best, jnp.where(better, fresh, run.error)), nominal_error(plant, policy)

    return jax.vmap(advance)(runs, plants)


def _start(
    method: Method, seeds: Sequence[int], plants: environment.Lungs
) -> tuple[_Run, NDArray[np.float32]]:
    numbers = jnp.asarray(np.asarray(seeds, np.uint32))
    keys = jax.vmap(jax.random.key)(numbers)
    states = jax.vmap(method.init)(keys)
    best = jax.vmap(method.policy)(states)  # type: ignore[arg-type]
    errors = np.asarray(jax.jit(jax.vmap(nominal_error))(plants, best))
    return _Run(states, best, jnp.full(len(seeds), jnp.inf)), errors


def train(
    method: Method,
    plants: environment.Lungs,
    seeds: Sequence[int],
    *,
    chunk: int,
    identity: str = "",
    file: Path | None = None,
    progress: RunsProgress = lambda share, errors: None,
) -> TrainedPolicies:
    """Train R policies side by side.

    Bit-reproducible on one machine: all random numbers come from the seeds, and an interrupted
    training goes on as if it had not been.

    Args:
        method: the recipe, common to all: ``breaths`` in each of ``iterations``; the states by
            ``init(key)`` and ``iterate(state, plants)``, and the ``policy(state)`` learned so far.
        plants: lungs of each run, an axis ``(R, ...)`` in front of all leaves; taken in float32.
        seeds: one for each run.
        chunk: iterations between two points of the curves.
        identity: text that tells one training from another, such as the simulators' hash.
        file: checkpoint that is resumed from and written to; kept at the end.
        progress: see :data:`RunsProgress`.

    Raises:
        InputError: if the checkpoint belongs to another training.
        FloatingPointError: if a policy diverges.
    """
    with compilation.float32():
        plants = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), plants)
        runs, first = _start(method, seeds, plants)
        points = -(-method.iterations // chunk)
        curves = np.full((len(seeds), points + 1), np.nan, np.float32)
        curves[:, 0] = first
        seconds, compiling = np.zeros(points + 1), np.zeros(())
        carry: Any = (runs, curves, seconds, compiling)
        settings = {
            "method": type(method).__name__,
            "recipe": asdict(method),
            "seeds": list(map(int, seeds)),
            "chunk": chunk,
            "about": identity,
            "jax": jax.__version__,
        }
        stored = Checkpoint(file, settings)
        (runs, curves, seconds, compiling), point = stored.restore(carry)
        began = time.perf_counter()
        if point < points:  # once for nothing, so that no point's time contains the compiling
            jax.block_until_ready(_advance(method, runs, plants, chunk))
        saved = now = time.perf_counter()
        compiling = compiling + (now - began)
        while point < points:
            runs, errors = _advance(method, runs, plants, chunk)
            point += 1
            curves[:, point] = np.asarray(errors)
            before, now = now, time.perf_counter()
            seconds[point] = seconds[point - 1] + now - before
            if not np.isfinite(curves[:, point]).all():
                raise FloatingPointError(f"training diverged before point {point} of {points}")
            if now - saved > SAVE_SECONDS or point == points:
                stored.save((runs, curves, seconds, compiling), point)
                saved = now
            progress(point / points, np.asarray(runs.error))
        return TrainedPolicies(
            policies=jax.tree.map(np.asarray, runs.best),
            validation=np.asarray(runs.error),
            episodes=np.arange(points + 1) * chunk * method.breaths,
            curves=curves,
            seconds=seconds,
            compile_seconds=float(compiling),
        )


#: Called with what is trained, the share that is done and the best error so far, cmH2O.
Progress = Callable[[str, float, float], None]


@dataclass(frozen=True)
class Recipe:
    """Published settings of a method."""

    name: str  #: of the method, as reports and checkpoints have it.
    per_lung: Method  #: settings for one lung.
    every: Method  #: settings for all six.
    chunk: int  #: iterations between two points of a learning curve.


def shortened(method: Any, name: str, steps: int | None) -> Any:
    """Settings with so many control steps of experience; as they are if not given.

    Raises:
        InputError: if the steps do not make one iteration.
    """
    if steps is None:
        return method
    iterations = steps // (method.breaths * environment.MOVES)
    if iterations < 1:
        raise InputError(
            f"{steps} steps are less than one iteration of {name}, "
            f"{method.breaths} breaths of {environment.MOVES} steps"
        )
    return replace(method, iterations=iterations)


def train_networks(
    recipe: Recipe,
    networks: Sequence[str] | None,
    out: Path,
    *,
    seeds: Sequence[int] = (0, 1),
    steps: int | None = None,
    simulator: SimulatorLike = "frozen",
    progress: Progress = lambda label, share, best: None,
) -> TrainedControllers:
    """Train networks that correct a PID.

    Writes ``weights.npz``, as the entry of the method reads it, ``training.json`` and, of each of
    several seeds, ``weights-SEED.npz``. Of the trainings of a network the one with the lowest error
    on freshly drawn cells is kept; the published draws have no part in that choice. An interrupted
    training continues where it was.

    Args:
        recipe: method and its settings.
        networks: ids of lungs, a network each, or ``"all"`` for one network that serves all; if not
            given, a network for each lung of the simulators and one for all of several.
        out: folder; checkpoints lie there until all is done.
        seeds: seeds of the trainings of each network.
        steps: control steps of experience of each training; those of the recipe if not given.
        simulator: simulators with plants, see :func:`ventbench.load_simulators`.
        progress: see :data:`Progress`.

    Returns:
        The best policy of each network, float32, and the report.

    Raises:
        InputError: if a network's name is unknown, ``steps`` do not make one iteration, or ``out``
            holds an unfinished training with other settings.
        FloatingPointError: if a training diverges.
    """
    began = time.perf_counter()
    name, trained_on = recipe.name, plants_to_train_on(simulator)
    names, available = check_names(networks, trained_on), trained_on.names
    if networks is None and len(available) > 1:
        names = (*names, ALL)
    lungs_of = {lung: [k] for k, lung in enumerate(available)} | {ALL: [*range(len(available))]}
    # Networks that see equally many lungs are trained side by side.
    single = tuple(network for network in names if network != ALL)
    groups = {"one": (single, recipe.per_lung)} if single else {}
    if ALL in names:
        groups["all"] = (ALL,), recipe.every if len(available) > 1 else recipe.per_lung
    groups = {
        kind: (group, shortened(method, name, steps)) for kind, (group, method) in groups.items()
    }
    best, report = {}, {}
    by_seed: dict[int, dict[str, Any]] = {seed: {} for seed in seeds}
    for kind, (group, method) in groups.items():
        lungs = _lungs(trained_on, [lungs_of[network] for network in group for _ in seeds])
        trained = train(
            method,
            lungs,
            [seed for _ in group for seed in seeds],
            chunk=recipe.chunk,
            identity=f"{group} {fingerprint(lungs)}",
            file=out / f".{name}-{kind}.npz",
            progress=lambda share, errors, group=group: progress(
                ", ".join(group), share, float(errors.mean())
            ),
        )
        pids = _pid_errors(lungs)
        for index, network in enumerate(group):
            runs = slice(index * len(seeds), (index + 1) * len(seeds))
            for seed, run in zip(seeds, range(runs.start, runs.stop), strict=True):
                by_seed[seed][network] = jax.tree.map(lambda x, run=run: x[run], trained.policies)
            chosen = seeds[int(np.argmin(trained.validation[runs]))]
            best[network] = by_seed[chosen][network]
            report[network] = {
                "seed": int(chosen),
                "error_fresh": trained.validation[runs].tolist(),
                "error_nominal_at_end": trained.curves[runs, -1].tolist(),
                "breaths": int(trained.episodes[-1]),
                "training_seconds": round(float(trained.seconds[-1]), 1),
                "error_pid": pids[runs.start],
            }
    result = {
        "method": name,
        "recipes": {kind: asdict(method) for kind, (_, method) in groups.items()},
        "networks": report,
        "simulators": dict(trained_on.about),
        "jax": jax.__version__,
        "seconds": round(time.perf_counter() - began, 1),
    }
    residual.save_policies(out / "weights.npz", best)
    for seed in seeds if len(seeds) > 1 else ():
        residual.save_policies(out / f"weights-{seed}.npz", by_seed[seed])
    files.write_json(out / "training.json", result)
    for kind in groups:
        (out / f".{name}-{kind}.npz").unlink(missing_ok=True)
    return TrainedControllers(best, result, out)


def _lungs(trained_on: TrainingPlants, of_runs: list[list[int]]) -> environment.Lungs:
    """Lungs of each run by their indices, an axis of R in front."""
    index = np.array(of_runs)
    plants = jax.tree.map(lambda leaf: np.asarray(leaf)[:, index], trained_on.plants)
    # (plants, runs, lungs, ...) -> (runs, plants, lungs, ...)
    plants = jax.tree.map(lambda leaf: np.moveaxis(leaf, 1, 0), plants)
    return environment.Lungs(plants, jnp.asarray(trained_on.weights[index]))


def _pid_errors(lungs: environment.Lungs) -> list[float]:
    """Nominal error of the PID that is corrected, on the lungs of each run, cmH2O."""
    with compilation.float32():
        lungs = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), lungs)
        pid = PID(*residual.GAINS)
        errors = jax.jit(jax.vmap(lambda run_lungs: nominal_error(run_lungs, pid)))(lungs)
        return [float(error) for error in errors]


def options(description: str, out: Path) -> argparse.ArgumentParser:
    """Parser of the options of all trainings of networks: which, of which seeds, on what, where."""
    parser = argparse.ArgumentParser(description=description)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--lung", metavar="ID", help="only the network for this lung")
    which.add_argument("--all", action="store_true", help="only one network for all lungs")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first training")
    parser.add_argument("--seeds", type=int, default=1, help="trainings; the best is kept")
    parser.add_argument(
        "--simulator", dest="plant", default="frozen", help="simulators to train on"
    )
    parser.add_argument("--out", type=Path, default=out, help="folder for the results")
    return parser


@contextmanager
def asked(
    parser: argparse.ArgumentParser,
) -> Iterator[tuple[argparse.Namespace, tuple[str, ...] | None, range]]:
    """What a command line asks for, its networks and its seeds; errors end it with a sentence."""
    arguments = parser.parse_args()
    compilation.keep()
    names = (ALL,) if arguments.all else arguments.lung and (arguments.lung,)
    try:
        yield arguments, names, range(arguments.seed, arguments.seed + arguments.seeds)
    except InputError as error:
        parser.exit(1, f"error: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, "interrupted; the same command continues\n")


def command(recipe: Recipe, description: str) -> None:
    """Train the networks of an entry, as a command line asks."""
    parser = options(description, Path("runs", recipe.name))
    parser.set_defaults(seeds=2)
    parser.add_argument("--steps", type=int, help="control steps of experience of each training")
    with asked(parser) as (arguments, names, seeds):
        trained = train_networks(
            recipe,
            names,
            arguments.out,
            seeds=seeds,
            steps=arguments.steps,
            simulator=arguments.plant,
            progress=lambda label, share, best: print(f"{label}: {share:.0%}, {best:.3f} cmH2O"),
        )
        print(trained.to_frame().to_string())
