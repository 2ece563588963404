"""Ablation of the residual controller: its score when one part is removed or changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from proofs.studies import BASE, Progress, Tell, chosen, trained
from submissions.residual_mlp.train import ResidualConfig, fit
from ventbench.base import compilation
from ventbench.base.arrays import Floats
from ventbench.board.replay import spread
from ventbench.plants import frozen
from ventbench.plants.rigs import Rigs
from ventbench.plants.stacking import take
from ventbench.task import protocol, rollouts
from ventbench.task.interfaces import Controller
from ventbench.task.lungs import LUNGS
from ventbench.task.metrics.score import run_error
from ventbench.train import pid_search

#: Published draws to score on.
DRAWS = 20

#: Figures by which trainings are compared.
FIGURES = ("nominal", "draws", "exploitation")

Gains = tuple[float, float, float]


@dataclass(frozen=True)
class Variant:
    """One way to train."""

    meaning: str  #: the variant in words.
    config: ResidualConfig  #: settings of the training.
    direct: bool = False  #: whether the network commands alone, without a PID to correct.


def variants(config: ResidualConfig) -> dict[str, Variant]:
    """Variants of the settings by name; each differs from the base in one thing."""

    def changed(meaning: str, **fields: Any) -> Variant:
        return Variant(meaning, replace(config, **fields))

    wide = max(config.widths)
    return {
        BASE: Variant("as the submission is trained", config),
        "direct": Variant("no PID, the network alone computes the command", config, direct=True),
        "one simulator": changed("only the official simulator of each lung", members=1),
        "no deviations": changed("training without noise, delay or other R and C", spread=0.0),
        "no breath before": changed("no features of the previous breath", ahead=0),
        "no errors before": changed("no earlier errors of this breath", pressures=0),
        "no commands before": changed("no earlier commands of this breath", commands=0),
        "twice as far back": changed(
            "twice as many errors and commands",
            pressures=2 * config.pressures,
            commands=2 * config.commands,
        ),
        "narrow": changed("a quarter of the width", widths=(wide // 4,) * len(config.widths)),
        "wide": changed("twice the width", widths=(2 * wide,) * len(config.widths)),
        "shallow": changed("one hidden layer", widths=(wide,)),
        "deep": changed("four hidden layers", widths=(wide,) * 4),
    }


def compare(
    simulators: frozen.Frozen,
    out: Path,
    seeds: Sequence[int],
    *,
    config: ResidualConfig,
    only: Sequence[str] | None = None,
    draws: int = DRAWS,
    gains: Gains | None = None,
    workers: int = 0,
    progress: Progress = lambda *_: None,
) -> pd.DataFrame:
    """Train one network for all six lungs by each variant with each seed.

    Finished trainings are read from ``out``.

    Args:
        simulators: simulators to train through and to score on.
        out: folder.
        seeds: one for each training of a variant.
        config: settings of the base.
        only: names of variants; all if not given. The base is always included.
        draws: published draws to score on.
        gains: P, I, D of the PID; the best single set of the paper's grid if not given.
        workers: processes, each with a training at a time; 0 for this one alone.
        progress: see :data:`Progress`.

    Returns:
        A row for each training: ``variant``, ``seed`` and :data:`FIGURES`, cmH2O.

    Raises:
        InputError: if ``out`` holds other trainings.
        FloatingPointError: if a training diverges.
    """
    gains = gains or best_single(simulators)
    about = {
        "config": asdict(config),
        "gains": list(gains),
        "draws": draws,
        "simulators": simulators.about(),
    }
    rows = (out / "rows").resolve()
    jobs = {
        (name, str(seed)): (simulators, gains, variant, seed, draws, rows / f"{name}-{seed}.npz")
        for name, variant in chosen(variants(config), only).items()
        for seed in seeds
    }
    found = trained(out, about, _trained, jobs, workers, progress)
    return pd.DataFrame(
        {"variant": name, "seed": int(seed)} | row for (name, seed), row in found.items()
    )


def best_single(simulators: frozen.Frozen) -> Gains:
    """P, I, D of the paper's grid with the lowest mean error over the six lungs."""
    grid = pid_search.paper_gains()
    error = pid_search.errors(simulators.plants, grid).mean(axis=(0, 2))
    P, I, D = (float(gain) for gain in grid[int(np.argmin(error))])  # noqa: E741
    return P, I, D


def summary(runs: pd.DataFrame) -> pd.DataFrame:
    """A row a variant: mean over seeds, and the range of its difference to the base's same seed."""
    base: Any = runs[runs["variant"] == BASE].set_index("seed")
    rows = []
    group: Any
    for name, group in runs.groupby("variant", sort=False):
        row: dict[str, Any] = {"variant": name, "seeds": len(group)}
        apart = group.set_index("seed")[list(FIGURES)] - base[list(FIGURES)]
        for figure in FIGURES:
            row[figure] = group[figure].mean()
            row[f"{figure}_change_low"] = apart[figure].min()
            row[f"{figure}_change_high"] = apart[figure].max()
        rows.append(row)
    return pd.DataFrame(rows)


def stored(runs: pd.DataFrame, config: ResidualConfig) -> dict[str, Any]:
    """JSON values of trainings by some settings, for the paper's page."""
    known, seeds = variants(config), runs["seed"].nunique()
    command = f"python -m proofs study controllers --seeds {seeds} --updates {config.updates}"
    return {
        "about": {"command": command, "simulators": 1},
        "variants": [
            {"variant": row["variant"], "meaning": known[str(row["variant"])].meaning}
            | {figure: round(float(row[figure]), 4) for figure in FIGURES}
            for row in summary(runs).to_dict("records")
        ],
    }


def _trained(
    simulators: frozen.Frozen,
    gains: Gains,
    variant: Variant,
    seed: int,
    draws: int,
    checkpoint: Path,
    tell: Tell,
) -> dict[str, float]:
    with compilation.float32():
        controller = fit(
            jax.tree.map(np.asarray, simulators.ensemble),
            (0.0, 0.0, 0.0) if variant.direct else gains,
            config=variant.config,
            seed=seed,
            checkpoint=checkpoint,
            progress=lambda done, total, _: tell(done / total),
            keep=True,
        )
    error, exploitation = score_controller(simulators, controller, draws)
    checkpoint.unlink()
    return {
        "nominal": float(error[:, 0].mean()),
        "draws": float(error[:, 1:].mean()) if draws else float("nan"),
        "exploitation": exploitation,
    }


def score_controller(
    simulators: frozen.Frozen, controller: Controller, draws: int
) -> tuple[Floats, float]:
    """Score a pure controller on all six lungs.

    Returns:
        Errors, cmH2O, ``(6, 1 + draws, 6)``, the nominal ones first; the exploitation index, cmH2O.
    """
    errors, requested = [], []
    with compilation.float64():
        rigs, pips = Rigs(LUNGS, simulators.plants), protocol.PIPS
        _, every = rigs.cells(rigs.draws(draws, pips) if draws else None, pips)
        wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), controller)
        for index in range(len(LUNGS)):
            cells = jax.tree.map(lambda leaf, k=index: jnp.asarray(leaf[k]), every)
            plant = jax.tree.map(jnp.asarray, take(simulators.plants, index))
            run, _ = rollouts.closed_loop(plant, wide, cells)
            errors.append(run_error(run.pressure, np.asarray(cells.pip)[..., None, None]))
            requested.append(np.asarray(run.requested))
    nominal = np.stack(requested)[:, 0]
    return np.stack(errors), float(spread(simulators, pips, nominal).mean())
