"""The manifest of the frozen simulators: where they come from, and how far they err."""

from __future__ import annotations

import dataclasses
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from ventbench import files, open_loop_report
from ventbench.lungs import LUNG_IDS, lung
from ventbench.plants import frozen
from ventbench.plants.learned import Architecture
from ventbench.plants.sessions import Sessions
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants
from ventbench.plants.two_balloon import two_balloon
from ventbench.rollouts import PlantsFor

if TYPE_CHECKING:
    from ventbench.training.freeze import Recordings

VERSION = 1

#: Packages that have a part in the numbers.
PACKAGES = ("flax", "jax", "jaxlib", "numpy", "optax")


def provenance(
    data: Recordings, recipe: Any, network_recipe: Any, architecture: Architecture
) -> dict[str, Any]:
    """What a training is made of: recordings, split, recipes, packages; JSON and TOML values."""
    sources = {}
    for part in (data.measured, data.reconstructed):
        name = Path(part.source or "").name
        sources[name] = {"sha256": part.sha256, "breaths": len(part)}
    held_out = [
        data.measured.breath_id[data.fold == fold].tolist() for fold in np.unique(data.fold)
    ]
    return {
        "format": frozen.FORMAT,
        "version": VERSION,
        "kind": "hybrid",
        "packages": {name: metadata.version(name) for name in PACKAGES},
        "recordings": sources,
        "split": {"by": "breath", "seed": data.seed, "held_out": held_out},
        "recipe": {
            "hybrid": dataclasses.asdict(recipe),
            "learned": dataclasses.asdict(network_recipe),
            "learned_architecture": dataclasses.asdict(architecture),
        },
    }


def judge(
    simulators: frozen.Frozen, learned: frozen.FrozenLearned, data: Recordings
) -> dict[str, Any]:
    """Test simulators on the measured breaths.

    Returns:
        ``lungs``: for each of the six, its R, C, reference session, and the open-loop errors, see
        :func:`~ventbench.open_loop_report.summary`, cmH2O: ``held_out_...`` of each breath by the
        member that has not seen it; ``official_...`` of member 0 on breaths that it has not seen;
        ``training_...`` of member 0 on the others. ``comparison``: held-out errors by kind of
        plant, then lung.
    """
    measured = data.measured
    official = open_loop_report.errors(simulators.for_breaths, measured)
    kinds: dict[str, PlantsFor] = {
        "hybrid": simulators.cross_fitted,
        "learned": learned.cross_fitted,
        "single_compartment": partial(nominal_plants, single_compartment),
        "two_balloon": partial(nominal_plants, two_balloon),
    }
    found = {
        kind: open_loop_report.errors(plants_for, measured) for kind, plants_for in kinds.items()
    }
    lungs = {}
    for name in LUNG_IDS:
        index = measured.by_lung_index[name]
        new = simulators.unseen(measured)[index]
        setting = lung(name)
        lungs[name] = {
            "R": setting.R,
            "C": setting.C,
            "session": reference(simulators.sessions, name),
            **_figures("held_out_", found["hybrid"][index]),
            **_figures("official_", official[index][new]),
            **_figures("training_", official[index][~new]),
        }
    comparison = {
        kind: {name: _figures("", error[index]) for name, index in measured.by_lung_index.items()}
        for kind, error in found.items()
    }
    return {"lungs": lungs, "comparison": comparison}


def reference(table: Sessions, lung_id: str) -> int:
    """The session that stands for a lung: the one with the most breaths, the first of equals."""
    counts = [session.breaths if session.lung == lung_id else -1 for session in table.table]
    return int(np.argmax(counts))


def write(path: Path, manifest: dict[str, Any]) -> None:
    """Write a manifest as TOML, in one step."""
    files.write_text(path, tomli_w.dumps(manifest))


def _figures(prefix: str, error: NDArray[np.float64]) -> dict[str, Any]:
    """Summary, empty where there is no breath, as TOML knows no null."""
    summary = open_loop_report.summary(prefix, error)
    return _rounded(summary) if summary[f"{prefix}breaths"] else {}


def _rounded(value: Any) -> Any:
    """To 1e-6 cmH2O, which no machine's arithmetic changes by itself."""
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part) for part in value]
    return round(value, 6) if isinstance(value, float) else value
