"""The official simulators: six lungs learned from real recordings, fixed by their hashes.

Each lung is a set of rigs: the sessions of the recordings that are what their label says, by a test
whose figures the manifest holds. They form an ensemble of six. Member 0, by which the paper's score
is made, has seen every recording. Member k has seen all but those of fold k - 1, so that each
measured breath is new to one of them.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench.base import files
from ventbench.base.arrays import Bools, Ints
from ventbench.base.errors import InputError
from ventbench.base.files import data_path
from ventbench.plants.hybrid import Hybrid, RigPopulation, load_population
from ventbench.plants.plant_files import load_plant
from ventbench.plants.sessions import Sessions
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.identity import Fingerprints, fingerprints, match, repetitions

#: Format of the manifest.
FORMAT = "ventbench-simulators-2"
ROLES_FORMAT = "ventbench-population-1"
MANIFEST, MEMBERS, TRAINING_LIST = "manifest.toml", "hybrid.npz", "seen.npz"
POPULATION = "population.npz"

#: What rounds draw rigs from, and the rigs that are held out: beside the manifest, whose hash every
#: score names.
ROLES = "population.toml"

#: SHA-256 of the official one, which holds that of the population.
ROLES_SHA256 = "f593a610bc4db77f83119e1b3797fb848300c3412cd04ee7674f2b5086d1c293"

#: SHA-256 of the official manifest, which holds those of all its files.
MANIFEST_SHA256 = "e4b214dd47b9233918260c0576bf76ce15eb1629309be0ae05cf04394fe368e9"

#: SHA-256 of the official list of training breaths. No score depends on the list, so it may be
#: another than the manifest's, which every score names.
TRAINING_LIST_SHA256 = "8c66a6c3822b18cbf24b0e8a2e8b2ad7bbdeae969dc4329eb15b72cc68b2039a"

#: Fold of a breath that every member has seen, and of one that none has.
BY_ALL, BY_NONE = -1, -2


@dataclass(frozen=True)
class TrainingBreaths:
    """The breaths of the training."""

    prints: Fingerprints  #: their fingerprints, of k breaths.
    fold: NDArray[np.int8]  #: member that has not seen the breath, or :data:`BY_ALL`, ``(k,)``.

    def folds(self, breaths: Breaths) -> Ints:
        """Look breaths up: a fold, :data:`BY_ALL` or :data:`BY_NONE`, shape ``(n,)``.

        What is perhaps a copy counts as one.
        """
        index = match(breaths, self.prints).known
        return np.where(index >= 0, self.fold[index].astype(np.int64), BY_NONE)


@dataclass(frozen=True, eq=False)
class Frozen:
    """Version and parameters of the official simulators.

    Plants that it gives have numpy leaves: they take the precision in force where they are used.
    """

    folder: Path  #: folder that the files were read from.
    manifest: dict[str, Any]  #: content of the manifest: provenance, split, sessions, errors.
    manifest_sha256: str  #: SHA-256 of the manifest.
    sessions: Sessions  #: what a breath's clock is compared with.
    members: Hybrid  #: float64 leaves ``(members, sessions, ...)``.
    training_breaths: TrainingBreaths  #: the breaths of the training.
    #: that rigs of each lung are drawn from; None where none was fitted.
    population: RigPopulation | None = None

    def __repr__(self) -> str:
        """Lungs and folder."""
        return f"<Frozen simulators of {', '.join(self.lung_ids)} in {self.folder}>"

    @property
    def lung_ids(self) -> tuple[str, ...]:
        """Lungs of :attr:`plants` in their order: the six, or those of other recordings."""
        return tuple(self.manifest["lungs"])

    @property
    def _references(self) -> Ints:
        return np.array([entry["session"] for entry in self.manifest["lungs"].values()])

    @property
    def rigs(self) -> tuple[tuple[int, ...], ...]:
        """Sessions that are scored, for each of :attr:`lung_ids`, for the six those of ``LUNGS``.

        They passed the test of their label. The first is the lung's reference rig, whose plant is
        in :attr:`plants`.
        """
        return tuple(tuple(entry["rigs"]) for entry in self.manifest["lungs"].values())

    @property
    def held_out_rigs(self) -> tuple[tuple[int, ...], ...]:
        """For each lung the scored sessions on which no entry may be trained.

        At least a third of those that passed, by the rule of
        :func:`ventbench.train.rigs.train.choose_rigs`; none where only one passed.
        """
        return self._of_lungs("held_out_rigs")

    @property
    def seen_rigs(self) -> tuple[tuple[int, ...], ...]:
        """Those of :attr:`held_out_rigs` that entries were trained on before they were held out."""
        return self._of_lungs("seen_rigs")

    def _of_lungs(self, key: str) -> tuple[tuple[int, ...], ...]:
        return tuple(tuple(entry.get(key, ())) for entry in self.manifest["lungs"].values())

    @property
    def training_rigs(self) -> tuple[tuple[int, ...], ...]:
        """For each lung :attr:`rigs` without those of :attr:`held_out_rigs`."""
        pairs = zip(self.rigs, self.held_out_rigs, strict=True)
        return tuple(tuple(rig for rig in rigs if rig not in apart) for rigs, apart in pairs)

    @property
    def rejected(self) -> dict[int, str]:
        """Why a session is not scored, by its index."""
        tests = self.manifest["label_tests"]
        return {test["session"]: test["reason"] for test in tests if "reason" in test}

    @property
    def sessions_plants(self) -> Hybrid:
        """Plants of all sessions and members, leaves ``(members, sessions, ...)``."""
        return self.members

    @property
    def plants(self) -> Hybrid:
        """The simulators of :attr:`lung_ids`, for the six leaves ``(6, ...)`` as in ``LUNGS``."""
        at = self._references
        return jax.tree.map(lambda leaf: leaf[0, at], self.members)

    @property
    def ensemble(self) -> Hybrid:
        """All members, leaves ``(members, 6, ...)``; the first are :attr:`plants`."""
        at = self._references
        return jax.tree.map(lambda leaf: leaf[:, at], self.members)

    def for_breaths(self, breaths: Breaths) -> Hybrid:
        """Official simulators of n breaths: of their lung, on the rig that their clock tells.

        Raises:
            InputError: if a lung is none of the recorded settings.
        """
        return self._of(breaths, np.zeros(len(breaths), np.int64))

    def cross_fitted(self, breaths: Breaths) -> Hybrid:
        """Plants of the member that has not seen each breath; of member 0 if all have seen it."""
        return self._of(breaths, np.maximum(self.training_breaths.folds(breaths), 0))

    def held_out(self, breaths: Breaths) -> Bools:
        """Whether some member has not seen the breath, so that it can be judged by it, ``(n,)``."""
        return self.training_breaths.folds(breaths) != BY_ALL

    def unseen(self, breaths: Breaths) -> Bools:
        """Whether the official simulators, member 0, have not seen the breath, ``(n,)``."""
        return self.training_breaths.folds(breaths) == BY_NONE

    def perhaps_copies(self, breaths: Breaths) -> Bools:
        """Whether the breath may be one of the training, but blank pressures do not tell, (n,)."""
        matches = match(breaths, self.training_breaths.prints)
        return (matches.known >= 0) & ~matches.certain

    def _of(self, breaths: Breaths, member: Ints) -> Hybrid:
        at = self.sessions.assign(breaths)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[member, at]), self.members)

    def lungs(self) -> dict[str, dict[str, Any]]:
        """Settings and held-out errors of the lungs, by id."""
        return {name: dict(entry) for name, entry in self.manifest["lungs"].items()}

    def about(self) -> dict[str, Any]:
        """Version and hashes that a score states of its simulators."""
        hashes = {name: self.manifest["files"][name]["sha256"] for name in (MEMBERS, TRAINING_LIST)}
        about = {key: self.manifest[key] for key in ("version", "kind")}
        return {**about, "manifest_sha256": self.manifest_sha256, "files": hashes}


def training_list(breaths: Breaths, fold: Ints) -> TrainingBreaths:
    """Make the list; a breath of which there are copies in several folds was seen by all."""
    copy, _ = repetitions(breaths)
    folds = fold.astype(np.int8)
    folds[copy[folds != folds[copy]]] = BY_ALL
    prints, first = fingerprints(breaths), np.flatnonzero(copy == np.arange(len(copy)))
    first = first[np.argsort(prints.commands[first, 0])]  # not in the order of the recordings
    return TrainingBreaths(prints.select(first), folds[first])


def folder() -> Path:
    """Folder of the official simulators."""
    return data_path("simulators")


def load(path: Path | None = None) -> Frozen:
    """Read the official simulators, or those of a folder, and check them against the manifest.

    Raises:
        InputError: if a file is missing or is not what the manifest says.
    """
    if path is None and files.sha256(folder() / ROLES) != ROLES_SHA256:
        raise InputError(f"{folder() / ROLES} is damaged or changed: restore it")
    path = path or folder()
    manifest = _manifest(path)
    members = load_plant(_checked(path, MEMBERS, manifest))
    with np.load(_checked(path, TRAINING_LIST, manifest), allow_pickle=False) as arrays:
        if "commands" not in arrays:
            raise InputError(
                f"{path / TRAINING_LIST} is of an older version, which did not know copies with "
                "fewer digits; train the simulators again"
            )
        names = [field.name for field in fields(Fingerprints)]
        training = TrainingBreaths(Fingerprints(*(arrays[name] for name in names)), arrays["fold"])
    table = Sessions.from_list(manifest["sessions"])
    population = None
    if POPULATION in manifest["files"]:
        population = load_population(_checked(path, POPULATION, manifest))
    return Frozen(
        path, manifest, files.sha256(path / MANIFEST), table, members, training, population
    )


def _manifest(path: Path) -> dict[str, Any]:
    manifest = _toml(path / MANIFEST, FORMAT)
    if (path / ROLES).is_file():
        roles = _toml(path / ROLES, ROLES_FORMAT)
        for lung, settings in roles.get("lungs", {}).items():
            manifest["lungs"][lung] |= settings
        manifest["files"] |= roles["files"]
        manifest["population"] = roles["population"]
    return manifest


def _toml(path: Path, form: str) -> dict[str, Any]:
    try:
        values = tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    if values.get("format") != form:
        raise InputError(
            f"{path}, key format: {values.get('format')!r} is not {form!r}; this ventbench reads "
            "no other"
        )
    return values


def _checked(path: Path, name: str, manifest: dict[str, Any]) -> Path:
    try:
        digest, expected = files.sha256(path / name), manifest["files"][name]["sha256"]
    except (OSError, KeyError) as error:
        raise InputError(f"{path / name} is missing, or the manifest lacks it: {error}") from error
    if digest != expected and (name, digest) != (TRAINING_LIST, TRAINING_LIST_SHA256):
        raise InputError(
            f"{path / name} has SHA-256 {digest[:16]}..., the manifest says {expected[:16]}...; "
            "it is damaged or changed: restore it, or reinstall ventbench"
        )
    return path / name
