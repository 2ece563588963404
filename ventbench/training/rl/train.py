"""Networks for the lungs by PPO or DQN: settings, trainings of several seeds, weights, a report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ventbench import files, precision
from ventbench.controllers import rl_policy
from ventbench.controllers.pid import PID
from ventbench.errors import InputError
from ventbench.plants.catalog import Given
from ventbench.resume import fingerprint
from ventbench.training.rig_plants import TrainingPlants, plants_to_train_on
from ventbench.training.rl import episodes
from ventbench.training.rl.dqn import DQN
from ventbench.training.rl.parallel import TrainedPolicies, nominal_error, train
from ventbench.training.rl.policy_gradient import PolicyGradient
from ventbench.training.rl.ppo import PPO
from ventbench.training.trained import ALL, TrainedControllers, check_names

#: Names of the methods, as commands and tables have them.
METHODS = ("policy-gradient", "ppo", "dqn")

#: Iterations between two points of a learning curve.
CHUNKS = {"policy-gradient": 10, "ppo": 10, "dqn": 50}

Method = PolicyGradient | PPO | DQN

_ONE_LUNG: dict[str, Method] = {"policy-gradient": PolicyGradient(), "ppo": PPO(), "dqn": DQN()}
_ALL_LUNGS: dict[str, Method] = {
    "policy-gradient": PolicyGradient(breaths=36),
    "ppo": PPO(breaths=288, widths=(64, 64)),
    "dqn": DQN(breaths=72, memory=7200, widths=(128, 128)),
}

#: Called with what is trained, the share that is done and the best error so far, cmH2O.
Progress = Callable[[str, float, float], None]


def train_ppo(
    networks: Sequence[str] | None = None,
    out: Path | str = "runs/ppo",
    *,
    seeds: Sequence[int] = (0, 1),
    steps: int | None = None,
    method: PPO | None = None,
    simulator: Given = "frozen",
    version: int = 1,
    progress: Progress | None = None,
) -> TrainedControllers:
    """Train corrections of a PID by proximal policy optimisation.

    Writes ``weights.npz``, as ``submissions/ppo`` reads it, and ``training.json``. Of the trainings
    of a network the one with the lowest error on freshly drawn cells is kept; the published draws
    have no part in that choice. An interrupted training continues where it was.

    Example::

        trained = ventbench.train_ppo(["R20C50"], "runs/mine", steps=60_000)
        trained.report["networks"]["R20C50"]["error_fresh"]  # cmH2O, by seed

    Args:
        networks: ids of lungs, a network each, or ``"all"`` for one network that serves all; if not
            given, a network for each lung of the simulators and one for all of several.
        out: folder; checkpoints lie there until all is done.
        seeds: seeds of the trainings of each network.
        steps: control steps of experience of each training; those of the method if not given.
        method: settings of every training; the published ones, which differ for one lung and for
            all six, if not given.
        simulator: simulators with plants, see :func:`ventbench.load_simulators`.
        version: of the protocol to train for, see
            :func:`ventbench.training.rig_plants.plants_to_train_on`.
        progress: see :data:`Progress`.

    Returns:
        The best policy of each network, float32, and the report.

    Raises:
        InputError: if a network's name is unknown, ``steps`` do not make one iteration, or ``out``
            holds an unfinished training with other settings.
        FloatingPointError: if a training diverges.
    """
    return _train("ppo", networks, out, seeds, steps, method, simulator, version, progress)


def train_dqn(
    networks: Sequence[str] | None = None,
    out: Path | str = "runs/dqn",
    *,
    seeds: Sequence[int] = (0, 1),
    steps: int | None = None,
    method: DQN | None = None,
    simulator: Given = "frozen",
    version: int = 1,
    progress: Progress | None = None,
) -> TrainedControllers:
    """Train a choice among 19 corrections of a PID by deep Q-learning.

    Writes ``weights.npz``, as ``submissions/dqn`` reads it, and ``training.json``. Arguments,
    the choice of the best seed and errors are those of :func:`train_ppo`.

    Example::

        trained = ventbench.train_dqn(["R20C50"], "runs/mine", steps=60_000)
        trained.report["networks"]["R20C50"]["error_fresh"]  # cmH2O, by seed
    """
    return _train("dqn", networks, out, seeds, steps, method, simulator, version, progress)


def method_for(name: str, lungs: int, steps: int | None = None, version: int = 1) -> Method:
    """Return the published settings of a method.

    Args:
        name: one of :data:`METHODS`.
        lungs: on which one network is trained: 1 or 6.
        steps: control steps of experience; those of the published settings if not given.
        version: of the protocol; in version 2 the features look back at the breath before.

    Raises:
        InputError: if the steps do not make one iteration.
    """
    method = (_ONE_LUNG if lungs == 1 else _ALL_LUNGS)[name]
    return _shortened(replace(method, looks_back=version == 2), name, steps)


def _shortened(method: Method, name: str, steps: int | None) -> Method:
    if steps is None:
        return method
    iterations = steps // (method.breaths * episodes.STEPS)
    if iterations < 1:
        raise InputError(
            f"{steps} steps are less than one iteration of {name}, "
            f"{method.breaths} breaths of {episodes.STEPS} steps"
        )
    return replace(method, iterations=iterations)


@dataclass(frozen=True)
class _Group:
    """Networks that are trained side by side: of ``names``, each on ``lungs`` lungs."""

    names: tuple[str, ...]
    lungs: int


def _groups(names: Sequence[str], lungs: int) -> list[_Group]:
    """Split networks to train into those of one lung and that of all lungs."""
    single = tuple(name for name in names if name != ALL)
    groups = [_Group(single, 1)] if single else []
    return [*groups, _Group((ALL,), lungs)] if ALL in names else groups


def _train(
    name: str, networks: Sequence[str] | None, out: Path | str, seeds: Sequence[int],
    steps: int | None, method: Method | None, simulator: Given, version: int,
    progress: Progress | None,
) -> TrainedControllers:  # fmt: skip
    began = time.perf_counter()
    trained_on, out = plants_to_train_on(simulator, version), Path(out)
    known = list(trained_on.names)
    names = check_names(networks, trained_on)
    if networks is None and len(known) > 1:
        names = (*names, ALL)
    groups = _groups(names, len(known))
    methods = [
        method_for(name, group.lungs, steps, version)
        if method is None
        else _shortened(method, name, steps)
        for group in groups
    ]
    report = progress or (lambda *_: None)
    policies, about, checkpoints, used = {}, {}, [], {}
    for group, settings in zip(groups, methods, strict=True):
        label, kind = ", ".join(group.names), "all" if ALL in group.names else "one"
        checkpoints.append(out / f".{name}-{kind}.npz")
        plants = _lungs(trained_on, version, group, len(seeds))
        trained = train(
            settings,
            plants,
            [seed for _ in group.names for seed in seeds],
            chunk=CHUNKS[name],
            about=f"{group.names} {fingerprint(plants)}",
            file=checkpoints[-1],
            progress=lambda share, best, label=label: report(label, share, float(best.mean())),
        )
        pids = _pid_errors(plants)
        used[kind] = asdict(settings)
        for index, network in enumerate(group.names):
            about[network], best = _best_run(trained, index, seeds)
            about[network]["error_pid"] = pids[index * len(seeds)]
            policies[network] = jax.tree.map(lambda leaf, best=best: leaf[best], trained.policies)
    result = {
        "method": name,
        "recipes": used,
        "networks": about,
        "protocol": version,
        "simulators": dict(trained_on.about),
        "jax": jax.__version__,
        "seconds": round(time.perf_counter() - began, 1),
    }
    rl_policy.save_weights(out / "weights.npz", policies)
    files.write_json(out / "training.json", result)
    for checkpoint in checkpoints:
        checkpoint.unlink(missing_ok=True)
    return TrainedControllers(policies, result, out)


def _lungs(trained_on: TrainingPlants, version: int, group: _Group, seeds: int) -> episodes.Lungs:
    """Lungs of each run, an axis of R in front: the seeds of a network in a row."""
    known = list(trained_on.names)
    if ALL in group.names:
        where = np.repeat([list(range(len(known)))], seeds, axis=0)
    else:
        where = np.repeat([[known.index(name)] for name in group.names], seeds, axis=0)
    if version == 1:
        return jax.tree.map(lambda leaf: np.asarray(leaf)[where], trained_on.nominal)
    plants = jax.tree.map(lambda leaf: np.asarray(leaf)[:, where], trained_on.plants)
    # (plants, runs, lungs, ...) -> (runs, plants, lungs, ...)
    plants = jax.tree.map(lambda leaf: np.moveaxis(leaf, 1, 0), plants)
    return episodes.RigLungs(plants, jnp.asarray(trained_on.weights[where]))


def _pid_errors(lungs: episodes.Lungs) -> list[float]:
    """Nominal error of the PID that is corrected, on the lungs of each run, cmH2O."""
    with precision.float32():
        lungs = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), lungs)
        pid = PID(*rl_policy.GAINS)
        errors = jax.jit(jax.vmap(lambda own: nominal_error(own, pid)))(lungs)
        return [float(error) for error in errors]


def _best_run(
    trained: TrainedPolicies, network: int, seeds: Sequence[int]
) -> tuple[dict[str, Any], int]:
    """Entries of a network in the report, and the index of its best run."""
    first = network * len(seeds)
    rows = slice(first, first + len(seeds))
    best = first + int(np.argmin(trained.validation[rows]))
    about = {
        "seed": int(seeds[best - first]),
        "error_fresh": [float(value) for value in trained.validation[rows]],
        "error_nominal_at_end": [float(value) for value in trained.curves[rows, -1]],
        "breaths": int(trained.episodes[-1]),
        "training_seconds": round(float(trained.seconds[-1]), 1),
    }
    return about, best
