"""Train the networks by gradients through the simulators, and write ``weights.npz``.

    python submissions/residual_mlp/train.py --seeds 5 --updates 533          # one for each lung
    python submissions/residual_mlp/train.py --all --seeds 5 --updates 2000   # residual_mlp_all

Ctrl-C keeps the finished work; the same command continues.

The paper's objective, the mean of ``|pressure - PIP| + lambda |correction|`` over inspirations, is
differentiated through the controller, the valve and the simulator. Each update runs every lung at
every PIP, several times: on any training rig and member, with deviations drawn as those of the
scored draws are. Errors are divided by what there is to gain in the cell, as in the normalised
score. The gains of the PIDs are the best of the grid.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from numpy.typing import ArrayLike

from ventbench.base import compilation, files
from ventbench.base.arrays import Floats
from ventbench.base.resume import Checkpoint, fingerprint
from ventbench.controllers.pid import PID
from ventbench.controllers.residual import Residual, save_weights, untrained
from ventbench.plants.catalog import SimulatorLike
from ventbench.plants.stacking import take
from ventbench.task import draws, protocol, rollouts
from ventbench.task import environment as env
from ventbench.task.environment import Scenario, nominal_scenario
from ventbench.task.interfaces import Controller, Plant
from ventbench.task.metrics.score import run_error
from ventbench.train.pid_search import tune_pid
from ventbench.train.plants import ALL, TrainedControllers, check_names, plants_to_train_on
from ventbench.train.rl import environment
from ventbench.train.rl.train import asked, fresh_error, options


@dataclass(frozen=True)
class ResidualConfig:
    """Settings of the training of residual controllers; hashable, as they are static in ``jit``."""

    updates: int = 3000  #: number of updates of the network; the schedule stretches over them.
    copies: int = 6  #: runs of each lung at each PIP in an update.
    learning_rate: float = 4e-3  #: peak of the cosine schedule of Adam.
    weight_decay: float = 1e-5  #: decay of the network's weights.
    #: weight of the mean absolute correction, cmH2O for each %; the paper's lambda.
    lam: float = 0.0
    first_breath: float = 0.1  #: weight of the breath that is not scored; each scored breath has 1.
    widths: tuple[int, ...] = (64, 64)  #: units of the network's hidden layers.
    pressures: int = 5  #: number of earlier errors that it sees.
    commands: int = 6  #: number of earlier commands that it sees.
    ahead: int = 6  #: number of steps of the previous breath that it sees; 0 for none.
    limit: float = 100.0  #: largest correction, %.
    #: plants of each lung that are trained on, the nominal one first; all if None.
    members: int | None = None
    spread: float = 1.0  #: reach of the deviations, as a multiple of the draws' ranges; 0 for none.

    def __post_init__(self) -> None:
        """Refuse numbers that cannot work.

        Raises:
            ValueError: naming the field and its value.
        """
        for name in ("updates", "copies", "learning_rate", "limit", "members"):
            if getattr(self, name) is not None and not getattr(self, name) > 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must be positive")
        for name in ("weight_decay", "lam", "first_breath", "pressures", "commands", "ahead"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"training: {name} = {getattr(self, name)} must not be negative")
        if not 0 <= self.spread <= 4:
            raise ValueError(f"training: spread = {self.spread} is outside 0..4")


@jax.custom_vjp
def valve(u_in: Array) -> Array:
    """Clip a command to the valve's range, %, with a derivative where it leads back into it."""
    return jnp.clip(u_in, 0.0, protocol.U_MAX)


def _valve_forward(u_in: Array) -> tuple[Array, Array]:
    return valve(u_in), u_in


def _valve_backward(u_in: Array, gradient: Array) -> tuple[Array]:
    # Beyond an end of the range only a gradient that leads back into it passes.
    stuck = ((u_in > protocol.U_MAX) & (gradient < 0)) | ((u_in < 0) & (gradient > 0))
    return (jnp.where(stuck, 0.0, gradient),)


valve.defvjp(_valve_forward, _valve_backward)


@flax.struct.dataclass
class DifferentiableRun:
    """One run of three inspirations; every array ``(..., BREATHS, INSPIRATION_STEPS)``."""

    pressure: Array  #: airway pressure, cmH2O.
    correction: Array  #: correction of the PID's command, %.
    u_in: Array  #: command as applied, %.


def run(controller: Residual, plant: Plant, cell: Scenario) -> DifferentiableRun:
    """Run a controller through three inspirations.

    Args:
        controller: the controller.
        plant: plant of one lung.
        cell: one cell, batch shape ``()``.
    """

    def policy(state: Any, observation: Any, _: Any) -> tuple[Any, Array]:
        inner, base, correction = controller.parts(state[0], observation)
        return (inner, correction), valve(base + correction)

    def step(carry: tuple[env.LoopState, Any], at: tuple[Array, Array]) -> tuple[Any, Any]:
        # In one scan over all breaths: half the compilation of a scan of scans.
        varied = env.vary(plant, cell, at[0])
        rest = env.start_breath(varied, cell)
        start = jax.tree.map(lambda new, old: jnp.where(at[1] == 0, new, old), rest, carry[0])
        (after, state), (pressure, applied) = rollouts.control_step(
            varied,
            cell,
            policy,
            lambda before, _, __, u: (before.signals.scored, u),
            (start, carry[1]),
            (*at, None),
        )
        return (after, state), DifferentiableRun(pressure, state[1], applied)

    count = jnp.arange(protocol.BREATHS * protocol.INSPIRATION_STEPS)
    at = (count // protocol.INSPIRATION_STEPS, count % protocol.INSPIRATION_STEPS)
    rest = env.start_breath(env.vary(plant, cell, 0), cell)
    begin = (rest, (controller.init(()), jnp.zeros_like(cell.pip)))
    _, steps = jax.lax.scan(step, begin, at)
    shape = (protocol.BREATHS, protocol.INSPIRATION_STEPS)
    return jax.tree.map(lambda leaf: leaf.reshape(shape), steps)


def objective(
    controller: Residual,
    plants: Plant,
    cells: Scenario,
    first_breath: float,
    lam: float,
    *,
    weight: Array | float = 1.0,
) -> Array:
    """Mean of ``|pressure - PIP| + lam |correction|`` over inspirations and runs.

    Args:
        controller: the controller.
        plants: leaves ``(n, ...)``.
        cells: batch shape ``(n,)``.
        first_breath: weight of the first breath; the others have 1.
        lam: cmH2O for each %.
        weight: of each run, shape ``(n,)`` or ``()``.

    Returns:
        The loss, cmH2O.
    """
    runs = jax.vmap(run, (None, 0, 0))(controller, plants, cells)
    scored = jnp.isin(jnp.arange(protocol.BREATHS), jnp.array(protocol.SCORED_BREATHS))
    breath = jnp.where(scored, 1.0, first_breath)[:, None]
    costs = jnp.abs(runs.pressure - cells.pip[:, None, None]) + lam * jnp.abs(runs.correction)
    total = jnp.mean(costs * breath * jnp.reshape(weight, (-1, 1, 1)))
    return total / jnp.mean(breath)


#: Updates compiled into one scan; a checkpoint or a Ctrl-C falls between two of them.
CHUNK = 50


def optimiser(
    updates: int, learning_rate: float, weight_decay: float
) -> optax.GradientTransformation:
    """AdamW with clipped gradients; the rate warms up and then falls along a cosine."""
    warm = max(updates // 50, 1)
    schedule = optax.warmup_cosine_decay_schedule(0.0, learning_rate, warm, max(updates, warm + 1))
    return optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=weight_decay)
    )


def _chunk(
    update: Callable[[Any, Array], tuple[Any, Array]], carry: Any, first: Array, updates: int
) -> tuple[Any, Array]:
    """:data:`CHUNK` updates from number ``first`` on, none beyond the last; state and mean loss."""

    def inside(carry: Any, number: Array) -> tuple[Any, Array]:
        new, loss = update(carry, number)
        return jax.tree.map(lambda a, b: jnp.where(number >= updates, a, b), carry, new), loss

    numbers = first + jnp.arange(CHUNK)
    carry, losses = jax.lax.scan(inside, carry, numbers)
    counted = numbers < updates
    return carry, jnp.sum(losses * counted) / jnp.maximum(jnp.sum(counted), 1)


@partial(jax.jit, static_argnames="config")
def _advance(
    carry: tuple[Any, Any],
    controller: Residual,
    plants: Plant,
    key: Array,
    first: Array,
    weights: Array,
    config: ResidualConfig,
) -> tuple[tuple[Any, Any], Array]:
    """``CHUNK`` updates, fewer at the end; returns layers, the optimiser's state and mean loss."""
    adam = optimiser(config.updates, config.learning_rate, config.weight_decay)
    members, lungs = jax.tree.leaves(plants)[0].shape[:2]
    pips = jnp.asarray(protocol.PIPS, jnp.float32)

    def update(carry: tuple[Any, Any], number: Array) -> tuple[tuple[Any, Any], Array]:
        layers, state = carry
        member_key, scenario_key = jax.random.split(jax.random.fold_in(key, number))
        # Lung and PIP of each run.
        cell = jnp.repeat(jnp.arange(lungs * len(pips)), config.copies)
        lung, pip = cell // len(pips), cell % len(pips)
        member = jax.random.randint(member_key, lung.shape, 0, members)
        cells = draws.random_scenarios(scenario_key, pips[pip], spread=config.spread, smooth=True)
        those = jax.tree.map(lambda leaf: leaf[member, lung], plants)

        def value(layers: Any) -> Array:
            corrected = controller.replace(layers=layers)  # type: ignore[attr-defined]
            return objective(
                corrected, those, cells, config.first_breath, config.lam, weight=weights[lung, pip]
            )

        mean, gradient = jax.value_and_grad(value)(layers)
        updates, state = adam.update(gradient, state, layers)
        return (optax.apply_updates(layers, updates), state), mean

    return _chunk(update, carry, first, config.updates)


def fit(
    plants: Plant,
    gains: tuple[float, float, float],
    *,
    config: ResidualConfig | None = None,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    keep: bool = False,
    weights: ArrayLike | None = None,
) -> Residual:
    """Train the correction of a PID on one lung, or on several at once.

    Bit-reproducible on one machine: every random number comes from ``seed`` and the number of
    the update, so that an interrupted training continues as if it had not been.

    Args:
        plants: simulators, leaves ``(members, lungs, ...)``; members beyond the settings' are left
            out.
        gains: P, I, D of the PID, %/cmH2O; they stay.
        config: settings of the training.
        seed: seed of the weights and the random deviations.
        checkpoint: file that the training is saved to every ``CHUNK`` updates and resumed from;
            deleted at the end.
        progress: called after every ``CHUNK`` updates with the number of those done, of all, and
            the mean loss since the last call, cmH2O.
        keep: leave the checkpoint, so that a finished training is read from it.
        weights: weight of each lung's error at each PIP, shape ``(lungs, P)``; 1 if not given.

    Returns:
        The controller, float32.

    Raises:
        InputError: if the checkpoint belongs to another training.
        FloatingPointError: if the loss is not finite; the checkpoint stays at the last good one.
    """
    config = config or ResidualConfig()
    plants = jax.tree.map(lambda leaf: jnp.asarray(leaf[: config.members], jnp.float32), plants)
    lungs = jax.tree.leaves(plants)[0].shape[1]
    shape = (lungs, len(protocol.PIPS))
    weights = jnp.broadcast_to(jnp.asarray(1.0 if weights is None else weights, jnp.float32), shape)
    start_key, key = jax.random.split(jax.random.key(seed))
    like = Residual(
        PID(*(jnp.asarray(gain, jnp.float32) for gain in gains)),
        (),
        pressures=config.pressures,
        commands=config.commands,
        ahead=config.ahead,
        limit=config.limit,
    )
    controller = untrained(start_key, like, config.widths)
    adam = optimiser(config.updates, config.learning_rate, config.weight_decay)
    carry: Any = (controller.layers, adam.init(controller.layers))
    settings = {
        "config": dataclasses.asdict(config),
        "gains": list(gains),
        "seed": seed,
        "simulators": fingerprint(plants),
        "weights": fingerprint(weights),
    }
    stored = Checkpoint(checkpoint, settings)
    carry, first = stored.restore(carry)
    while first < config.updates:
        new, loss = _advance(carry, like, plants, key, jnp.asarray(first), weights, config)
        loss = float(loss)
        if not np.isfinite(loss):
            raise FloatingPointError(
                f"training diverged between updates {first} and {first + CHUNK}"
            )
        carry, first = new, min(first + CHUNK, config.updates)
        stored.save(carry, first)
        if progress is not None:
            progress(first, config.updates, loss)
    if not keep:
        stored.delete()
    return controller.replace(layers=carry[0])  # type: ignore[attr-defined]


#: Files that are written.
WEIGHTS, RESULT, PARTS = "weights.npz", "training.json", "parts"

#: Called with the name of the step, and its progress: updates done, updates in all, loss in cmH2O.
Progress = Callable[[str, tuple[int, int, float] | None], None]


def train(
    networks: Sequence[str] | None = None,
    out: Path | str = "runs/residual",
    *,
    config: ResidualConfig | None = None,
    seeds: Sequence[int] = (0,),
    gains: Floats | None = None,
    simulator: SimulatorLike = "frozen",
    progress: Progress | None = None,
) -> TrainedControllers:
    """Train corrections of the best PIDs by differentiating through simulators.

    Writes ``weights.npz``, as the controller reads it, ``training.json`` and, of each of several
    seeds, ``weights-SEED.npz``. Of the trainings of a network the one with the lowest
    error on freshly drawn cells is kept. An interrupted training continues where it was; a finished
    one is repeated, to the same bytes.

    Args:
        networks: ids of lungs, a network each, or ``"all"`` for one network that serves all; a
            network for each lung of the simulators if not given.
        out: folder.
        config: settings of the training.
        seeds: seeds of the weights and the random deviations, of the trainings of each network.
        gains: grid of P, I, D, %/cmH2O, shape ``(G, 3)``, of which each network corrects the best
            PID; the paper's grid if not given.
        simulator: simulators with plants to train through, see :func:`ventbench.load_simulators`;
            of the frozen ones all members of all training rigs.
        progress: see :data:`Progress`.

    Returns:
        The controllers, float32, and the report.

    Raises:
        InputError: if a network's name or a simulator is unknown, or ``out`` holds an unfinished
            training with other settings.
        FloatingPointError: if a training diverges.
    """
    config, progress = config or ResidualConfig(), progress or (lambda what, state: None)
    trained_on, out = plants_to_train_on(simulator), Path(out)
    names, available = check_names(networks, trained_on), list(trained_on.names)
    progress("PID grid", None)
    official = trained_on.nominal
    lungs = {name: take(official, index) for index, name in enumerate(available)}
    _, tuned = tune_pid(available if ALL in names else names, gains=gains, simulator=simulator)
    by_seed: dict[int, dict[str, Residual]] = {seed: {} for seed in seeds}
    controllers, networks_report = {}, {}
    for name in names:
        best = tuple(tuned["single"]["gains"] if name == ALL else tuned["lungs"][name]["gains"])
        where = list(range(len(available))) if name == ALL else [available.index(name)]
        plants = jax.tree.map(
            lambda leaf, where=where: np.asarray(leaf)[:, where], trained_on.plants
        )
        weights = trained_on.weights[where]
        started, fresh = time.perf_counter(), []
        for seed in seeds:
            title = f"network {name}, seed {seed}" if len(seeds) > 1 else f"network {name}"
            with compilation.float32():
                by_seed[seed][name] = fit(
                    plants,
                    best,
                    config=config,
                    seed=seed,
                    keep=True,
                    weights=weights,
                    checkpoint=_checkpoint(out, name, seed),
                    progress=lambda *state, title=title: progress(title, state),
                )
                lungs_of = environment.Lungs(plants, jnp.asarray(weights))
                fresh.append(float(_fresh(lungs_of, by_seed[seed][name])))
        chosen = seeds[int(np.argmin(fresh))]
        controllers[name] = by_seed[chosen][name]
        networks_report[name] = {
            "gains": list(best),
            "seed": chosen,
            "seconds": round(time.perf_counter() - started, 1),
            "error_fresh": fresh,
            "error_pid": _errors(PID(*best), lungs, where),
            "error": _errors(controllers[name], lungs, where),
        }
    save_weights(out / WEIGHTS, controllers)
    for seed in seeds if len(seeds) > 1 else ():
        save_weights(out / f"weights-{seed}.npz", by_seed[seed])
    report = {
        "networks": networks_report,
        "recipe": dataclasses.asdict(config),
        "seeds": list(seeds),
        "simulators": dict(trained_on.about),
        "weights_sha256": files.sha256(out / WEIGHTS),
    }
    files.write_json(out / RESULT, report)
    for name in names:
        for seed in seeds:
            _checkpoint(out, name, seed).unlink(missing_ok=True)
    return TrainedControllers(controllers, report, out)


_fresh = jax.jit(fresh_error)


def _checkpoint(out: Path, name: str, seed: int) -> Path:
    return out / PARTS / f"{name}-{seed}.npz"


def _errors(
    controller: Controller, lungs: Mapping[str, Plant], where: list[int]
) -> dict[str, float]:
    """Nominal error on the reference plant of each lung, float64, cmH2O."""
    errors = {}
    with compilation.float64():
        cells = nominal_scenario(np.array(protocol.PIPS))
        wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), controller)
        for name in [list(lungs)[index] for index in where]:
            plant = jax.tree.map(jnp.asarray, lungs[name])
            inspirations, _ = rollouts.closed_loop(plant, wide, cells)
            error = run_error(inspirations.pressure, np.asarray(cells.pip)[:, None, None])
            errors[name] = round(float(error.mean()), 6)
    return errors


def main() -> None:
    """Train as the command line asks."""
    parser = options(
        "Train networks that correct the best PID: one for each lung, or what is asked for.",
        Path("runs/residual"),
    )
    parser.add_argument("--updates", type=int, default=ResidualConfig.updates)
    parser.add_argument("--members", type=int, help="plants of each lung; default: all")
    parser.add_argument(
        "--lambda", type=float, default=0.0, help="weight of the correction, cmH2O for each %%"
    )
    with asked(parser) as (given, names, seeds):
        config = ResidualConfig(
            updates=given.updates, members=given.members, lam=vars(given)["lambda"]
        )

        def show(step: str, state: tuple[int, int, float] | None) -> None:
            done = "" if state is None else f": {state[0]} of {state[1]}, {state[2]:.3f} cmH2O"
            print(step + done, flush=True)

        trained = train(
            names, given.out, config=config, seeds=seeds, simulator=given.plant, progress=show
        )
        print(trained.to_frame().to_string())


if __name__ == "__main__":
    main()
