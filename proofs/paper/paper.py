"""Every table and figure of the paper that needs no hardware, made again and set beside ours.

What takes seconds is computed: the PID grid, the bundled entries, an exploration. What takes
minutes or needs recordings is read from ``proofs/paper/stored.json``, where an earlier run of
:func:`reproduce_paper` with ``full`` and ``recordings`` has stored it with its provenance.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from proofs.paper import controller_sections as controllers
from proofs.paper import published
from proofs.paper import simulator_sections as simulators
from proofs.paper.report import Reproduction
from proofs.studies.networks import MEASURED
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.executor import executor, results
from ventbench.entries.scoring import score
from ventbench.plants import frozen
from ventbench.plants.rigs import rigs_of
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS, lung
from ventbench.train import pid_grid

#: File of stored results.
STORED = Path(__file__).with_name("stored.json")

#: Entry and track by the name that tables have.
ENTRIES = {
    "residual": ("residual_mlp", "performance"),
    "residual, all lungs": ("residual_mlp_all", "robustness"),
    "PPO": ("ppo", "performance"),
    "DQN": ("dqn", "performance"),
}


#: Points of a stored learning curve.
CURVE_POINTS = 40

#: Called with what is done and the share of all that is done.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class StudySizes:
    """How much the studies of ``full`` train; smaller ones try the whole out."""

    curves: float = 1.0  #: share of the full length of the trainings of the learning curves.
    updates: int = 400  #: updates of each training of the parts of the controller.
    draws: int = 20  #: published draws on which those are scored.
    parts: tuple[str, ...] | None = None  #: names of the parts that are varied; all if None.
    #: further arguments of :func:`proofs.studies.networks.compare`.
    networks: Mapping[str, Any] = field(default_factory=dict)


def reproduce_paper(
    *,
    recordings: Path | str | None = None,
    full: bool = False,
    out: Path | str = "runs/paper",
    seeds: int = 5,
    sizes: StudySizes | None = None,
    workers: int = 0,
    scheduler: str | None = None,
    gains: Floats | None = None,
    stored: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> tuple[Reproduction, dict[str, Any]]:
    """Set the paper's tables, figures and claims beside ours.

    Args:
        recordings: folder of the public recordings: errors by horizon are measured again.
        full: run the studies again too: learning curves, parts of the controller and, with
            ``recordings``, architectures; hours on 2 cores.
        out: folder in which ``full`` keeps finished trainings, so that the same call continues.
        seeds: trainings of each method and of each part of the controller with ``full``.
        sizes: of the studies of ``full``.
        workers: processes for entries and the studies of controllers and networks; 0 for
            this one alone.
        scheduler: address of a Dask scheduler instead.
        gains: P, I, D, %/cmH2O, shape ``(G, 3)``; the paper's 8,000 if not given. They must
            contain those of the paper's table.
        stored: results of minutes; those of ``proofs/paper/stored.json`` if not given.
        progress: see :data:`Progress`.

    Returns:
        The comparison, and what ``proofs/paper/stored.json`` should hold after this run.

    Raises:
        InputError: if a recording is malformed, or ``out`` is of other
            studies.

    Examples:
        >>> page, _ = reproduce_paper()  # doctest: +SKIP
        >>> print(page)  # doctest: +SKIP
    """
    tell = progress or (lambda what, share: None)
    official = frozen.load()
    kept = dict(load_stored() if stored is None else stored)
    if recordings is not None:
        tell("errors by horizon", 0.0)
        kept["horizon"] = simulators.measure_horizon(Path(recordings) / MEASURED)
    if full:
        source = None if recordings is None else Path(recordings)
        parallel = {"workers": workers, "scheduler": scheduler}
        kept |= _studies(Path(out), source, seeds, sizes or StudySizes(), parallel, tell)
    tell("PID grid", 0.1)
    tried = pid_grid.paper_gains() if gains is None else gains
    error = pid_grid.errors(official.plants, tried)
    grid = pid_grid.PIDGrid(LUNG_IDS, protocol.PIPS, tried, error)
    with executor(workers, scheduler) as pool:
        jobs = dict(ENTRIES)
        scored: dict[str, tuple[Floats, Floats]] = {}
        for name, result in results(pool, _scored, jobs):
            scored[name] = result
            tell(f"{name} scored", 0.4 + 0.4 * len(scored) / len(jobs))
    errors = {name: result[0] for name, result in scored.items()}
    tell("exploration and examples", 0.9)
    sections = (
        simulators.simulators(official, kept["horizon"]),
        simulators.by_horizon(kept["horizon"]),
        simulators.architectures(kept["networks"]),
        simulators.boundary(kept["networks"]),
        simulators.exploration(official),
        controllers.best_gains(grid),
        controllers.beyond_the_grid(rigs_of(official)),
        controllers.example(official, grid, scored["residual"][1]),
        controllers.performance(grid, errors["residual"]),
        controllers.robustness(grid, errors["residual"], errors["residual, all lungs"]),
        controllers.regularisation(kept["controllers"]),
        controllers.reinforcement(errors),
        controllers.sample_efficiency(kept["samples"]),
        controllers.stability(kept["samples"]),
    )
    about = {
        "ventbench": ventbench.__version__,
        "simulators": official.manifest_sha256[:12],
    }
    return Reproduction(about, sections, published.NOT_REPRODUCED), kept


def load_stored(path: Path | None = None) -> dict[str, Any]:
    """Read stored results.

    Raises:
        InputError: if they are missing or not JSON.
    """
    path = path or STORED
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error


def _scored(name: str, track: str) -> tuple[Floats, Floats]:
    """Errors and pressures of a bundled entry without noise, by lung and PIP."""
    result = score(name, track=track, sandbox=False)
    return result.nominal, result.trajectories.pressure


def _studies(
    out: Path, recordings: Path | None, seeds: int, sizes: StudySizes, parallel: Mapping[str, Any],
    tell: Progress,
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """Run the studies of minutes again, as JSON values; ``parallel``: workers and scheduler."""
    from proofs.studies import controllers, networks, samples
    from proofs.studies.networks import ARCHITECTURE
    from ventbench.train.residual import ResidualConfig

    kept: dict[str, dict[str, Any]] = {}
    curves = samples.sample_efficiency(
        lung("R20C50"), range(seeds), out / "samples", share=sizes.curves,
        progress=lambda method, share, best: tell(f"learning curves: {method}", share),
    )  # fmt: skip
    kept["samples"] = stored_samples(curves, seeds)
    config = ResidualConfig(updates=sizes.updates)
    runs = controllers.compare(
        frozen.load(), out / "controllers", range(seeds), config=config, only=sizes.parts,
        draws=sizes.draws, **parallel,
        progress=lambda what, share: tell(f"controllers: {what}", share),
    )  # fmt: skip
    known = controllers.variants(config)
    kept["controllers"] = {
        "about": {
            "command": "python -m proofs study controllers "
            f"--seeds {seeds} --updates {sizes.updates}",
            "simulators": 1,
        },
        "variants": [
            {"variant": row["variant"], "meaning": known[str(row["variant"])].meaning}
            | {figure: round(float(row[figure]), 4) for figure in controllers.FIGURES}
            for row in controllers.summary(runs).to_dict("records")
        ],
    }
    if recordings is not None:
        breaths = networks.compare(
            recordings, out / "networks", **parallel, **sizes.networks,
            progress=lambda what, share: tell(f"networks: {what}", share),
        )  # fmt: skip
        names = {"depth": "depth", "N_B": "boundaries", "H_p": "pressures", "H_c": "controls"}
        base = {key: getattr(ARCHITECTURE, field) for key, field in names.items()}
        table = networks.summary(breaths).round(4)
        kept["networks"] = {
            "about": {"command": "python -m proofs study networks", "simulators": 1},
            "base": base | {"width": ARCHITECTURE.width},
            "variants": table.to_dict("records"),
        }
    return kept


def stored_samples(curves: Any, seeds: int) -> dict[str, Any]:
    """Learning curves as they are stored: a few points, evenly apart in logarithms."""
    lines = {}
    for curve in curves.curves:
        last = len(curve.episodes) - 1
        at = np.unique(np.geomspace(1, max(last, 1), CURVE_POINTS).round().astype(int))
        lines[curve.method] = {
            "episodes": curve.episodes[at].tolist(),
            "score": np.round(curve.middle[at], 4).tolist(),
        }
    rows = curves.summary().to_dict("records")
    return {
        "about": {"command": f"python -m proofs study samples --seeds {seeds}", "simulators": 1},
        "lung": curves.lung,
        "seeds": seeds,
        "methods": [{k: None if v != v else v for k, v in row.items()} for row in rows],
        "curves": lines,
    }
