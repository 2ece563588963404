"""Sample efficiency: every method on one lung with several seeds, as table and picture.

The methods are those of the entries, and the policy gradient, which differentiates the error of
whole breaths through the simulator.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pandas as pd
from jax import Array

from submissions.dqn.train import DQN
from submissions.ppo.train import PPO
from ventbench.base import files
from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import require
from ventbench.board.comparison import over_seeds
from ventbench.controllers import residual
from ventbench.controllers.residual import SCALE, GaussianPolicy, Parameters, TanhNetwork
from ventbench.palette import RUNS
from ventbench.plants import frozen
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS, Lung
from ventbench.train import pid_search
from ventbench.train.rl import environment
from ventbench.train.rl.train import Method, State, train

#: How close to its final score counts as having reached it.
CLOSE = 0.02


@dataclass(frozen=True)
class LearningCurve:
    """One method: score against experience."""

    method: str  #: name.
    episodes: Ints  #: breaths that one training has seen, ``(points,)``.
    seconds: Floats  #: computing time of all seeds together, without compiling, ``(points,)``.
    compile_seconds: float  #: time of compiling, s.
    scores: Floats  #: nominal, cmH2O, ``(seeds, points)``.

    @cached_property
    def bands(self) -> Floats:
        """Interquartile mean over the seeds, and its 95 % interval's ends, ``(3, points)``."""
        each = [over_seeds(scores) for scores in self.scores.T]
        return np.array([(x.value, x.low, x.high) for x in each]).T

    def episodes_to(self, score: float) -> int | None:
        """Breaths until the interquartile mean is at or below a score; None if it never is."""
        points = np.flatnonzero(self.bands[0] <= score)
        return int(self.episodes[points[0]]) if points.size else None


@dataclass(frozen=True)
class SampleStudy:
    """Learning curves of all methods on one lung, and the scores of PIDs there."""

    lung: str  #: id of the lung.
    curves: tuple[LearningCurve, ...]  #: learning curves of the methods.
    start: float  #: nominal score of the PID that is corrected, cmH2O.
    best_pid: float  #: nominal score of the best PID of the paper's grid on this lung, cmH2O.

    def summary(self) -> pd.DataFrame:
        """One row for each method; ``episodes_...`` is blank where it is not reached."""
        return pd.DataFrame([self._row(curve) for curve in self.curves])

    def stored(self) -> dict[str, Any]:
        """JSON values for the paper's page."""
        seeds = len(self.curves[0].scores)
        return {
            "about": {
                "command": f"python -m proofs study samples --seeds {seeds}",
                "simulators": 1,
            },
            "lung": self.lung,
            "seeds": seeds,
            "methods": files.json_values(self.summary().to_dict("records")),
        }

    def _row(self, curve: LearningCurve) -> dict[str, object]:
        final, low, high = curve.bands[:, -1].tolist()
        at_100 = int(np.flatnonzero(curve.episodes <= 100)[-1])
        return {
            "method": curve.method,
            "final": round(final, 3),
            "low95": round(low, 3),
            "high95": round(high, 3),
            "episodes": int(curve.episodes[-1]),
            "at_100_episodes": round(float(curve.bands[0, at_100]), 3),
            "episodes_to_best_pid": curve.episodes_to(self.best_pid),
            "episodes_to_2_percent": curve.episodes_to((1.0 + CLOSE) * final),
            "seconds": round(float(curve.seconds[-1]), 1),
            "compile_seconds": round(curve.compile_seconds, 1),
        }


@dataclass(frozen=True)
class PolicyGradient:
    """Settings of the policy gradient; one iteration is one update."""

    breaths: int = 6  #: breaths of an update, three an episode, PIPs in turn.
    iterations: int = 1600  #: iterations of a training, over which the learning rate falls to zero.
    learning_rate: float = 3e-3  #: initial learning rate of Adam.
    widths: tuple[int, ...] = (32, 32)  #: hidden layers of the network.

    @property
    def network(self) -> TanhNetwork:
        """One output."""
        return TanhNetwork(self.widths, 1)

    @property
    def _optimiser(self) -> optax.GradientTransformation:
        schedule = optax.cosine_decay_schedule(self.learning_rate, self.iterations)
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))

    def init(self, key: Array) -> State:
        """Return the state at the start of a training."""
        network_key, key = jax.random.split(key)
        parameters = residual.init_parameters(self.network, network_key)
        return State(parameters, self._optimiser.init(parameters), key, jnp.zeros((), jnp.int32))

    def iterate(self, state: State, plants: environment.Lungs) -> State:
        """One update on lungs."""
        cells_key, roll_key, key = jax.random.split(state.key, 3)
        episodes = environment.of_iteration(cells_key, plants, self.breaths, state.iteration)

        def loss(parameters: Parameters) -> Array:
            def act(key: Array, x: Array, base: Array) -> tuple[Array, None]:
                mean: Array = self.network.apply(parameters, x)  # type: ignore[assignment]
                return base + SCALE * mean[..., 0], None

            return -jnp.mean(environment.roll(episodes, act, roll_key)[2])

        gradient = jax.grad(loss)(state.parameters)
        updates, optimiser = self._optimiser.update(gradient, state.optimiser, state.parameters)
        parameters = optax.apply_updates(state.parameters, updates)
        return State(parameters, optimiser, key, state.iteration + 1)

    def policy(self, state: State) -> GaussianPolicy:
        """The learned policy."""
        return GaussianPolicy(state.parameters, self.network)


#: Iterations between two points of a curve, by method.
CHUNKS = {"policy-gradient": 1, "policy-gradient-short": 1, "ppo": 2, "dqn": 8}

#: Called with the method, the share of it that is done, the lowest mean error so far, cmH2O.
Progress = Callable[[str, float, float], None]


def study_methods(share: float = 1.0) -> dict[str, Method]:
    """Settings of the study; ``share`` below 1 shortens all trainings."""
    # The short one has a schedule of 96 breaths: a higher rate that falls to zero in them.
    long = PolicyGradient()
    short = replace(long, iterations=96 // long.breaths, learning_rate=1e-2)
    methods = {
        "policy-gradient-short": short,
        "policy-gradient": long,
        "ppo": PPO(),
        "dqn": DQN(),
    }
    return {
        name: replace(recipe, iterations=max(int(share * recipe.iterations), 1))
        for name, recipe in methods.items()
    }


def sample_efficiency(
    lung: Lung,
    seeds: Sequence[int],
    out: Path,
    *,
    share: float = 1.0,
    progress: Progress = lambda *_: None,
) -> SampleStudy:
    """Train by every method with every seed; finished trainings are read from ``out``.

    All methods correct the same PID with the same features, see cells drawn from the same
    distributions and are judged by the score without noise.

    Args:
        lung: one of the six scored lungs.
        seeds: one for each training of a method.
        out: folder of the checkpoints.
        share: share of the full length of each training.
        progress: see :data:`Progress`.

    Raises:
        InputError: if ``out`` holds another study.
    """
    simulators = frozen.load()
    at = LUNG_IDS.index(lung.id)
    single = jax.tree.map(lambda leaf: leaf[at : at + 1], simulators.plants)
    lungs = jax.tree.map(
        lambda leaf: np.repeat(leaf[None], len(seeds), axis=0),
        environment.Lungs(
            jax.tree.map(lambda leaf: leaf[None], single), jnp.ones((1, len(protocol.PIPS)))
        ),
    )
    curves = []
    for name, recipe in study_methods(share).items():
        trained = train(
            recipe,
            lungs,
            seeds,
            chunk=min(CHUNKS[name], recipe.iterations),
            identity=f"study {lung.id} {simulators.manifest_sha256}",
            file=out / f"{name}.npz",
            progress=lambda done, error, name=name: progress(name, done, float(error.mean())),
        )
        seconds, scores = trained.seconds, trained.curves.astype(float)
        curves.append(
            LearningCurve(name, trained.episodes, seconds, trained.compile_seconds, scores)
        )
    grid = pid_search.errors(single, pid_search.paper_gains())[0].mean(axis=-1)
    start, best = float(curves[0].scores[0, 0]), float(grid.min())
    return SampleStudy(lung.id, tuple(curves), start, best)


#: What the curves are called in the picture.
CURVE_LABELS = {
    "policy-gradient": "policy gradient through the simulator",
    "policy-gradient-short": "the same, learning rate for 96 breaths",
    "ppo": "PPO",
    "dqn": "DQN",
}

_CURVE_COLORS = dict(zip(CURVE_LABELS, (RUNS[0], RUNS[3], RUNS[1], RUNS[2]), strict=True))


def learning_curves_png(study: SampleStudy) -> bytes:
    """Draw score against breaths of experience and against time.

    Lines are interquartile means; bands are their 95 % intervals.

    Raises:
        InputError: if matplotlib is missing.
    """
    require("matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.6), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _curves(left, study, lambda curve: curve.episodes)
    _curves(right, study, lambda curve: curve.seconds)
    left.set_xlabel("breaths of experience of one training")
    right.set_xlabel("seconds, all seeds together, without compiling")
    left.set_ylabel("score without noise, cmH2O")
    right.legend(loc="upper right", frameon=False, fontsize=9)
    seeds = len(study.curves[0].scores)
    figure.suptitle(f"{study.lung}: interquartile mean and 95 % band of {seeds} seeds", fontsize=11)
    output = io.BytesIO()
    figure.savefig(output, format="png")
    return output.getvalue()


def _curves(axes: Any, study: SampleStudy, across: Callable[[LearningCurve], Any]) -> None:
    names = list(CURVE_LABELS)
    for curve in sorted(study.curves, key=lambda curve: names.index(curve.method)):
        x, color = across(curve)[1:], _CURVE_COLORS[curve.method]
        middle, low, high = curve.bands[:, 1:]
        axes.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0)
        axes.plot(x, middle, color=color, linewidth=1.6, label=CURVE_LABELS[curve.method])
    axes.axhline(study.start, color="#5b636d", linestyle=":", linewidth=1.2)
    axes.axhline(study.best_pid, color="#5b636d", linestyle="--", linewidth=1.2)
    end = axes.get_xlim()[1]
    axes.annotate("the PID that is corrected", (end, study.start), va="bottom", ha="right", size=8)
    axes.annotate("best PID for this lung", (end, study.best_pid), va="bottom", ha="right", size=8)
    axes.set_xscale("log")
    lowest = min(float(np.min(curve.scores)) for curve in study.curves)
    axes.set_ylim(0.95 * lowest, 1.25 * study.start)  # room for the legend
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#d9dde2", linewidth=0.6)
