"""Ablation of the paper's simulator: windows, width, depth and boundary networks."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from proofs.studies import BASE, Progress, Tell, chosen, stitched, trained
from proofs.studies.stitched import Architecture, Training
from ventbench.base import files
from ventbench.recordings import Breaths, join, load
from ventbench.simulation import mean_errors
from ventbench.task.lungs import LUNG_IDS, RECORDED_LUNGS
from ventbench.task.metrics import bootstrap
from ventbench.train.rigs.data import assign_folds

#: Files of the public recordings that the networks learn from.
MEASURED, RECONSTRUCTED = "pvp_quicklung.csv", "pvp_quicklung_reconstructed.csv"

#: Weight of a reconstructed breath; a measured one has 1.
RECONSTRUCTED_WEIGHT = 0.4

#: Members of the ensemble and folds of the cross-validation, and the seed of the folds.
MEMBERS, SEED = 5, 0

#: The paper's networks, smaller: there are far fewer breaths than the paper had.
ARCHITECTURE = Architecture(width=48, depth=4)

#: Measured and reconstructed breaths, and the fold of each measured one.
TrainingData = tuple[Breaths, Breaths, np.ndarray]


def variants(base: Architecture) -> dict[str, Architecture]:
    """Architectures by name; each differs from the base in one thing."""
    changes: list[tuple[str, dict[str, int]]] = [
        *((f"H_p {n}", {"pressures": n}) for n in (1, 2, 10)),
        *((f"H_c {n}", {"controls": n}) for n in (1, 3, 20)),
        *((f"N_B {n}", {"boundaries": n}) for n in (0, 3)),
        *((f"width {n}", {"width": n}) for n in (12, 24, 150)),
        *((f"depth {n}", {"depth": n}) for n in (2, 3, 9)),
    ]
    return {BASE: base} | {name: replace(base, **change) for name, change in changes}


def compare(
    folder: Path,
    out: Path,
    *,
    base: Architecture = ARCHITECTURE,
    config: Training | None = None,
    members: int = MEMBERS,
    only: Sequence[str] | None = None,
    workers: int = 0,
    progress: Progress = lambda *_: None,
) -> pd.DataFrame:
    """Train each variant on each scored lung, once for each fold of the measured breaths.

    Each breath is judged by the network that has not seen it. What is finished is read from
    ``out``.

    Args:
        folder: folder of the public recordings.
        out: folder.
        base: architecture from which all others differ in one thing.
        config: settings of all trainings.
        members: folds of the measured breaths, and networks of each lung.
        only: names of variants; all if not given. The base is always included.
        workers: processes, each with a variant at a time; 0 for this one alone.
        progress: see :data:`Progress`.

    Returns:
        A row for each breath and variant: ``variant``, ``breath_id``, ``lung``, ``error``, cmH2O.

    Raises:
        InputError: if a recording is malformed, or ``out`` is of other trainings.
        OSError: if a file cannot be read or written.
    """
    config = config or Training()
    measured, reconstructed = load(folder / MEASURED), load(folder / RECONSTRUCTED)
    data = measured, reconstructed, assign_folds(measured, count=members, seed=SEED)
    judged = measured.select(np.isin(measured.lung_ids, LUNG_IDS))
    hashes = {name: files.sha256(folder / name) for name in (MEASURED, RECONSTRUCTED)}
    about = {
        "architecture": asdict(base),
        "config": asdict(config),
        "recordings": hashes,
        "members": members,
    }
    jobs = {
        (name,): (data, shape, config, members)
        for name, shape in chosen(variants(base), only).items()
    }
    columns = {"breath_id": judged.breath_id, "lung": judged.lung_ids}
    tables = [
        pd.DataFrame({"variant": name, **columns, "error": errors})
        for (name,), errors in trained(out, about, _judged, jobs, workers, progress).items()
    ]
    return pd.concat(tables, ignore_index=True)


def summary(breaths: pd.DataFrame) -> pd.DataFrame:
    """A row a variant: errors, and the mean difference to the base, paired by breath, 95 %."""
    table: Any = breaths.pivot(index="breath_id", columns="variant", values="error")
    lungs: Any = breaths.drop_duplicates("breath_id").set_index("breath_id")["lung"]
    rows = []
    for name in breaths["variant"].unique():
        apart = bootstrap.summary((table[name] - table[BASE]).to_numpy())
        mean: Any = table[name].groupby(lungs).mean()
        rows.append(
            {"variant": name, "mean": table[name].mean(), "median": table[name].median()}
            | {"change": apart.mean, "low95": apart.ci95[0], "high95": apart.ci95[1]}
            | {lung: mean[lung] for lung in LUNG_IDS if lung in mean}
        )
    return pd.DataFrame(rows)


def stored(breaths: pd.DataFrame) -> dict[str, Any]:
    """JSON values of a comparison of :data:`ARCHITECTURE`, for the paper's page."""
    names = {"depth": "depth", "N_B": "boundaries", "H_p": "pressures", "H_c": "controls"}
    base = {key: getattr(ARCHITECTURE, field) for key, field in names.items()}
    return {
        "about": {"command": "python -m proofs study networks", "simulators": 1},
        "base": base | {"width": ARCHITECTURE.width},
        "variants": summary(breaths).round(4).to_dict("records"),
    }


def _judged(
    data: TrainingData, shape: Architecture, config: Training, members: int, tell: Tell
) -> list[float]:
    """Open-loop error of each scored breath by the network that has not seen it, cmH2O, ``(n,)``.

    Each lung has a network a fold, which does not see the breaths of the fold.
    """
    measured, reconstructed, fold = data
    scored = np.isin(measured.lung_ids, LUNG_IDS)
    judged = measured.select(scored)
    error = np.full(len(judged), np.nan)
    ids = [lung.id for lung in RECORDED_LUNGS]
    for member, (at, name) in itertools.product(range(members), enumerate(LUNG_IDS)):
        seen = (measured.lung_ids == name) & (fold != member)
        breaths = [measured.select(seen), reconstructed.select(reconstructed.lung_ids == name)]
        weight = np.repeat([1.0, RECONSTRUCTED_WEIGHT], [len(part) for part in breaths])
        seed = member * len(ids) + ids.index(name)
        network = stitched.fit(join(breaths), weight, shape, config, seed)
        simulated = stitched.simulate(network, judged.pressure[:, 0], judged.u_in, judged.dt)
        unseen = (judged.lung_ids == name) & (fold[scored] == member)
        error[unseen] = mean_errors(np.asarray(simulated), judged)[unseen]
        tell((member + (at + 1) / len(LUNG_IDS)) / members)
    return error.tolist()
