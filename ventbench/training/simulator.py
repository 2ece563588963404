"""The frozen simulators: from the public recordings to their files, the same ones every time.

The files hold an ensemble of hybrid plants, the paper's networks for comparison, the fingerprints
of the breaths that each member has seen, and a manifest of their origin and their errors.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tomli_w
from numpy.typing import NDArray

from ventbench import files, open_loop_report, precision
from ventbench.lungs import LUNG_IDS, RECORDED_LUNGS, Lung, lung
from ventbench.plants import frozen, sessions
from ventbench.plants.frozen import BY_ALL, seen
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.learned import Architecture, Learned
from ventbench.plants.plant_files import load_plant, save_plant
from ventbench.plants.sessions import Sessions
from ventbench.plants.single_compartment import single_compartment
from ventbench.plants.stacking import nominal_plants
from ventbench.plants.two_balloon import two_balloon
from ventbench.recordings import Breaths, folds, join, load
from ventbench.resume import Format, WorkFolder
from ventbench.rollouts import PlantsFor
from ventbench.training.hybrid.fit import HybridConfig, fit_member, session_plants, training_set
from ventbench.training.learned import LearnedConfig
from ventbench.training.learned import fit as fit_network

MEASURED, RECONSTRUCTED = "pvp_quicklung.csv", "pvp_quicklung_reconstructed.csv"

#: Members of the ensemble and folds of the cross-validation, and the seed of the folds.
MEMBERS, SEED = 5, 0

#: Version of the frozen simulators.
VERSION = 1

#: Packages that have a part in the numbers.
PACKAGES = ("flax", "jax", "jaxlib", "numpy", "optax")

#: The paper's networks, smaller: there are far fewer breaths than the paper had.
ARCHITECTURE = Architecture(width=48, depth=4)

#: A plant with numpy leaves as a finished result.
PLANT = Format(".npz", save_plant, partial(load_plant, as_array=np.asarray))

#: Called with what is being done and the share of all that is done, 0..1.
Progress = Callable[[str, float], None]

# Shares of the time that the two kinds take.
_HYBRID_SHARE, _LEARNED_SHARE = 0.45, 0.5


@dataclasses.dataclass(frozen=True)
class TrainingRecordings:
    """Recordings that the simulators are trained on.

    Attributes:
        measured: m breaths.
        reconstructed: breaths whose pressures were computed from the commands.
        fold: fold of each measured breath, ``(m,)``.
        seed: seed of the folds.
    """

    measured: Breaths
    reconstructed: Breaths
    fold: NDArray[np.int64]
    seed: int


def load_recordings(folder: Path, members: int = MEMBERS) -> TrainingRecordings:
    """Read the public recordings and deal the measured ones out to folds.

    Raises:
        InputError: if a file is malformed.
        OSError: if one cannot be read.
    """
    measured, reconstructed = load(folder / MEASURED), load(folder / RECONSTRUCTED)
    return TrainingRecordings(
        measured, reconstructed, folds(measured, count=members, seed=SEED), SEED
    )


def train_simulator(
    folder: Path | str,
    out: Path | str = "runs/simulators",
    *,
    config: HybridConfig | None = None,
    network_config: LearnedConfig | None = None,
    architecture: Architecture = ARCHITECTURE,
    members: int = MEMBERS,
    progress: Progress | None = None,
) -> frozen.Frozen:
    """Train all members and write the files of a version of the frozen simulators.

    On one machine with the same packages the files are the same byte for byte. Finished members are
    kept in ``out/parts`` until all is done, so that an interrupted training goes on.

    Example::

        simulators = ventbench.train_simulator("recordings", "runs/simulators")
        ventbench.score("pid_best", simulator="runs/simulators")

    Args:
        folder: folder of the public recordings.
        out: folder for the files; existing ones are replaced at the end.
        config: settings of the hybrid's fit.
        network_config: settings of the networks' training.
        architecture: sizes of the networks.
        members: members of the ensemble, each without one fold of the measured breaths.
        progress: see :data:`Progress`.

    Returns:
        The simulators, read back.

    Raises:
        InputError: if a recording is malformed, or ``out`` holds parts of another training.
        OSError: if a file cannot be read or written.
    """
    folder, out = Path(folder), Path(out)
    config, network_config = config or HybridConfig(), network_config or LearnedConfig()
    report = progress or (lambda what, share: None)
    report("reading the recordings", 0.0)
    data = load_recordings(folder, members)
    # The clocks alone, and of breaths that every member sees.
    table = sessions.find(data.reconstructed)
    about = provenance(data, config, network_config, architecture)
    parts = WorkFolder(out / "parts", about)
    with precision.float64():
        hybrids = list(_hybrid(data, table, config, members, parts, report))
    nets = list(_networks(data, network_config, architecture, members, parts, report))

    report("testing on held-out breaths", _HYBRID_SHARE + _LEARNED_SHARE)
    _write(out, about, table, data, _stack(hybrids), _stack(nets))
    parts.delete()
    report("done", 1.0)
    return frozen.load(path=out)


def _write(
    out: Path,
    about: dict[str, Any],
    table: Sessions,
    data: TrainingRecordings,
    members: Hybrid,
    nets: Learned,
) -> None:
    known = seen(
        join([data.measured, data.reconstructed]),
        np.append(data.fold, np.full(len(data.reconstructed), BY_ALL)),
    )
    save_plant(out / frozen.MEMBERS, members)
    save_plant(out / frozen.LEARNED, nets)
    files.write_atomically(
        out / frozen.SEEN, lambda file: np.savez(file, key=known.key, fold=known.fold)
    )
    names = (frozen.MEMBERS, frozen.LEARNED, frozen.SEEN)
    simulators = frozen.Frozen(out, {}, "", table, members, known)
    manifest = (
        about
        | {"files": {name: {"sha256": files.sha256(out / name)} for name in names}}
        | evaluate_simulators(simulators, frozen.FrozenLearned(nets, known), data)
        | {"sessions": table.to_list()}
    )
    files.write_text(out / frozen.MANIFEST, tomli_w.dumps(manifest))


def _hybrid(
    data: TrainingRecordings, table: Sessions, config: HybridConfig, members: int,
    parts: WorkFolder, report: Progress,
) -> Iterator[Any]:  # fmt: skip
    arranged = training_set(data.measured, data.reconstructed, data.fold, table, config)
    for member in range(members):

        def tell(share: float, member: int = member) -> None:
            report(f"hybrid, member {member}", _HYBRID_SHARE * (member + share) / members)

        def make(member: int = member, tell: Callable[[float], None] = tell) -> Any:
            return session_plants(fit_member(arranged, member, config, tell), table, config)

        tell(0.0)
        yield parts.get(f"hybrid-{member}", make, PLANT)


def _networks(
    data: TrainingRecordings, config: LearnedConfig, architecture: Architecture, members: int,
    parts: WorkFolder, report: Progress,
) -> Iterator[Any]:  # fmt: skip
    """One stack of networks over the settings for each member."""
    total = members * len(RECORDED_LUNGS)
    for member in range(members):
        nets = []
        for index, setting in enumerate(RECORDED_LUNGS):
            number = member * len(RECORDED_LUNGS) + index
            name = f"network-{setting.id}-{member}"
            report(
                f"network {setting.id}, member {member}",
                _HYBRID_SHARE + _LEARNED_SHARE * number / total,
            )

            def make(setting: Lung = setting, name: str = name, number: int = number) -> Learned:
                return train_network(
                    data, setting, number, architecture, config, parts.checkpoint(name)
                )

            nets.append(parts.get(name, make, PLANT))
        yield _stack(nets)


def train_network(
    data: TrainingRecordings, setting: Lung, number: int, architecture: Architecture,
    config: LearnedConfig, checkpoint: Path,
) -> Learned:  # fmt: skip
    """Train one of the paper's networks.

    Args:
        data: all recordings.
        setting: one of the recorded lung settings.
        number: number of the network: that of the setting among all, plus their count times the
            member; also the seed. A member does not see the measured breaths of the fold of its
            number.
        architecture: sizes of the network.
        config: settings of the training.
        checkpoint: see :func:`~ventbench.training.learned.fit`.
    """
    member = number // len(RECORDED_LUNGS)
    measured = data.measured.select((data.measured.lung_ids == setting.id) & (data.fold != member))
    more = data.reconstructed.select(data.reconstructed.lung_ids == setting.id)
    breaths = join([measured, more])
    weight = np.append(np.ones(len(measured)), np.full(len(more), HybridConfig.reconstructed))
    return fit_network(
        breaths.u_in,
        breaths.u_out,
        breaths.dt,
        breaths.pressure,
        architecture=architecture,
        config=config,
        seed=number,
        weight=weight,
        checkpoint=checkpoint,
    )


def _stack(plants: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *plants)


def provenance(
    data: TrainingRecordings, config: HybridConfig, network_config: LearnedConfig,
    architecture: Architecture,
) -> dict[str, Any]:  # fmt: skip
    """Recordings, split, settings and packages of a training, as JSON and TOML values."""
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
            "hybrid": dataclasses.asdict(config),
            "learned": dataclasses.asdict(network_config),
            "learned_architecture": dataclasses.asdict(architecture),
        },
    }


def evaluate_simulators(
    simulators: frozen.Frozen, learned: frozen.FrozenLearned, data: TrainingRecordings
) -> dict[str, Any]:
    """Errors of simulators on the measured breaths.

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
    errors = {
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
            "session": reference_session(simulators.sessions, name),
            **_figures("held_out_", errors["hybrid"][index]),
            **_figures("official_", official[index][new]),
            **_figures("training_", official[index][~new]),
        }
    comparison = {
        kind: {name: _figures("", error[index]) for name, index in measured.by_lung_index.items()}
        for kind, error in errors.items()
    }
    return {"lungs": lungs, "comparison": comparison}


def reference_session(table: Sessions, lung_id: str) -> int:
    """Index of the session that stands for a lung: the first with the most breaths."""
    counts = [session.breaths if session.lung == lung_id else -1 for session in table.table]
    return int(np.argmax(counts))


def _figures(prefix: str, error: NDArray[np.float64]) -> dict[str, Any]:
    """Summary, empty where there is no breath, as TOML knows no null."""
    summary = open_loop_report.summary(prefix, error)
    return _rounded(summary) if summary[f"{prefix}breaths"] else {}


def _rounded(value: Any) -> Any:
    """Round to 1e-6 cmH2O, which no machine's arithmetic changes by itself."""
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_rounded(part) for part in value]
    return round(value, 6) if isinstance(value, float) else value
