"""From the public recordings to the files of the frozen simulators, the same ones every time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from ventbench import files, precision
from ventbench.lungs import RECORDED_LUNGS, Lung
from ventbench.plants import frozen, sessions
from ventbench.plants.frozen import BY_ALL, seen
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.learned import Architecture, Learned
from ventbench.plants.plant_files import load_plant, save_plant
from ventbench.recordings import Breaths, folds, join, load
from ventbench.resume import Format, WorkFolder
from ventbench.training import learned as networks
from ventbench.training import manifest
from ventbench.training.hybrid.fit import Recipe
from ventbench.training.hybrid.member import fit_member, session_plants, training_set

MEASURED, RECONSTRUCTED = "pvp_quicklung.csv", "pvp_quicklung_reconstructed.csv"

#: Members of the ensemble and folds of the cross-validation, and the seed of the folds.
MEMBERS, SEED = 5, 0

#: The paper's networks, smaller: there are far fewer breaths than the paper had.
ARCHITECTURE = Architecture(width=48, depth=4)

#: A plant with numpy leaves as a finished result.
PLANT = Format(".npz", save_plant, partial(load_plant, as_array=np.asarray))

#: Called with what is being done and the share of all that is done, 0..1.
Progress = Callable[[str, float], None]

# Shares of the time that the two kinds take.
_HYBRID_SHARE, _LEARNED_SHARE = 0.45, 0.5


@dataclasses.dataclass(frozen=True)
class Recordings:
    """What the simulators are trained on.

    Attributes:
        measured: m breaths.
        reconstructed: breaths whose pressures were computed from the commands.
        fold: of each measured breath, ``(m,)``.
        seed: of the folds.
    """

    measured: Breaths
    reconstructed: Breaths
    fold: NDArray[np.int64]
    seed: int


def recordings(folder: Path) -> Recordings:
    """Read the public recordings and deal the measured ones out to folds.

    Raises:
        InputError: if a file is malformed.
        OSError: if one cannot be read.
    """
    measured, reconstructed = load(folder / MEASURED), load(folder / RECONSTRUCTED)
    return Recordings(measured, reconstructed, folds(measured, count=MEMBERS, seed=SEED), SEED)


def train(
    folder: Path,
    out: Path,
    *,
    recipe: Recipe | None = None,
    network_recipe: networks.Recipe | None = None,
    progress: Progress | None = None,
) -> frozen.Frozen:
    """Train all members and write the files of a version of the frozen simulators.

    On one machine with the same packages the files are the same byte for byte. Finished members are
    kept in ``out/parts`` until all is done, so that an interrupted training goes on.

    Args:
        folder: of the public recordings.
        out: where the files are written; those that are there are replaced at the end.
        recipe: of the hybrid.
        network_recipe: of the networks.
        progress: see :data:`Progress`.

    Returns:
        The simulators, read back.

    Raises:
        InputError: if a recording is malformed, or ``out`` holds parts of another training.
        OSError: if a file cannot be read or written.
    """
    recipe, network_recipe = recipe or Recipe(), network_recipe or networks.Recipe()
    report = progress or (lambda what, share: None)
    report("reading the recordings", 0.0)
    data = recordings(folder)
    # The clocks alone, and of breaths that every member sees.
    table = sessions.find(data.reconstructed)
    about = manifest.provenance(data, recipe, network_recipe, ARCHITECTURE)
    parts = WorkFolder(out / "parts", about)
    with precision.float64():
        members = list(_hybrid(data, table, recipe, parts, report))
    nets = list(_networks(data, network_recipe, parts, report))

    report("testing on held-out breaths", _HYBRID_SHARE + _LEARNED_SHARE)
    _write(out, about, table, data, _stack(members), _stack(nets))
    parts.delete()
    report("done", 1.0)
    return frozen.load(path=out)


def _write(
    out: Path,
    about: dict[str, Any],
    table: sessions.Sessions,
    data: Recordings,
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
    manifest.write(
        out / frozen.MANIFEST,
        about
        | {"files": {name: {"sha256": files.sha256(out / name)} for name in names}}
        | manifest.judge(simulators, frozen.FrozenLearned(nets, known), data)
        | {"sessions": table.to_list()},
    )


def _hybrid(
    data: Recordings, table: sessions.Sessions, recipe: Recipe, parts: WorkFolder, report: Progress
) -> Iterator[Any]:
    arranged = training_set(data.measured, data.reconstructed, data.fold, table, recipe)
    for member in range(MEMBERS):

        def tell(share: float, member: int = member) -> None:
            report(f"hybrid, member {member}", _HYBRID_SHARE * (member + share) / MEMBERS)

        def make(member: int = member, tell: Callable[[float], None] = tell) -> Any:
            return session_plants(fit_member(arranged, member, recipe, tell), table, recipe)

        tell(0.0)
        yield parts.get(f"hybrid-{member}", make, PLANT)


def _networks(
    data: Recordings, recipe: networks.Recipe, parts: WorkFolder, report: Progress
) -> Iterator[Any]:
    """One stack of networks over the settings for each member."""
    total = MEMBERS * len(RECORDED_LUNGS)
    for member in range(MEMBERS):
        nets = []
        for index, lung in enumerate(RECORDED_LUNGS):
            number = member * len(RECORDED_LUNGS) + index
            name = f"network-{lung.id}-{member}"
            report(
                f"network {lung.id}, member {member}",
                _HYBRID_SHARE + _LEARNED_SHARE * number / total,
            )

            def make(lung: Lung = lung, name: str = name, number: int = number) -> Learned:
                return network(data, lung, number, ARCHITECTURE, recipe, parts.checkpoint(name))

            nets.append(parts.get(name, make, PLANT))
        yield _stack(nets)


def network(
    data: Recordings, lung: Lung, number: int, architecture: Architecture,
    recipe: networks.Recipe, checkpoint: Path,
) -> Learned:  # fmt: skip
    """Train one of the paper's networks.

    Args:
        data: all recordings.
        lung: one of the recorded settings.
        number: of the network: that of the setting among all, plus their count times the member;
            also the seed. A member does not see the measured breaths of the fold of its number.
        architecture: of the network.
        recipe: of the training.
        checkpoint: see :func:`~ventbench.training.learned.fit`.
    """
    member = number // len(RECORDED_LUNGS)
    measured = data.measured.select((data.measured.lung_ids == lung.id) & (data.fold != member))
    more = data.reconstructed.select(data.reconstructed.lung_ids == lung.id)
    breaths = join([measured, more])
    weight = np.append(np.ones(len(measured)), np.full(len(more), Recipe.reconstructed))
    return networks.fit(
        breaths.u_in,
        breaths.u_out,
        breaths.dt,
        breaths.pressure,
        architecture=architecture,
        recipe=recipe,
        seed=number,
        weight=weight,
        checkpoint=checkpoint,
    )


def _stack(plants: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *plants)
