"""The official simulators: six lungs learned from real recordings, fixed by their hashes.

Version 1 is an ensemble of five: member k has seen every recording but those of fold k, so that
each measured breath is new to one of them. Member 0 is the official simulator, by which scores are
made. Version 2 makes of each lung a set of rigs: the sessions of the recordings that are what their
label says, by a test whose figures the manifest holds.
"""

from __future__ import annotations

import hashlib
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from ventbench import files
from ventbench.errors import InputError
from ventbench.files import data_path
from ventbench.interfaces import Plant
from ventbench.lungs import LUNGS, RECORDED_LUNGS
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.plant_files import load_plant
from ventbench.plants.sessions import Sessions
from ventbench.plants.stacking import VmappedPlant
from ventbench.recordings.breaths import Breaths

#: Formats of the manifest: one rig a lung, and a set of rigs a lung.
FORMAT, RIGS_FORMAT = "ventbench-simulators-1", "ventbench-simulators-2"
#: SHA-256 of the manifest of version 1, which holds those of all its files.
MANIFEST_SHA256 = "10d5cc74ada5ed307dfc0f26e2b90820fe110f69437992042fd02b3735ebeed7"
MANIFEST, MEMBERS, LEARNED, SEEN = "manifest.toml", "hybrid.npz", "learned.npz", "seen.npz"

#: Fold of a breath that every member has seen, and of one that none has.
BY_ALL, BY_NONE = -1, -2


@dataclass(frozen=True)
class Seen:
    """The breaths of the training.

    Attributes:
        key: :func:`fingerprints`, increasing, ``(k,)``.
        fold: member that has not seen the breath, or :data:`BY_ALL`, ``(k,)``.
    """

    key: NDArray[np.uint64]
    fold: NDArray[np.int8]

    def folds(self, breaths: Breaths) -> NDArray[np.int64]:
        """Look breaths up: a fold, :data:`BY_ALL` or :data:`BY_NONE`, shape ``(n,)``."""
        wanted = fingerprints(breaths)
        at = np.minimum(np.searchsorted(self.key, wanted), len(self.key) - 1)
        return np.where(self.key[at] == wanted, self.fold[at].astype(np.int64), BY_NONE)


@dataclass(frozen=True, eq=False)
class Frozen:
    """Version and parameters of the official simulators.

    Plants that it gives have numpy leaves: they take the precision in force where they are used.

    Attributes:
        folder: folder that the files were read from.
        manifest: content of the manifest: provenance, split, sessions, errors.
        manifest_sha256: SHA-256 of the manifest.
        sessions: what a breath's clock is compared with.
        members: float64 leaves ``(members, sessions, ...)``.
        seen: the breaths of the training.
    """

    folder: Path
    manifest: dict[str, Any]
    manifest_sha256: str
    sessions: Sessions
    members: Hybrid
    seen: Seen

    @property
    def lung_ids(self) -> tuple[str, ...]:
        """Lungs of :attr:`plants` in their order: the six, or those of other recordings."""
        return tuple(self.manifest["lungs"])

    @property
    def _references(self) -> NDArray[np.int64]:
        return np.array([about["session"] for about in self.manifest["lungs"].values()])

    @property
    def rigs(self) -> tuple[tuple[int, ...], ...]:
        """Sessions that are scored, for each of :attr:`lung_ids`, for the six those of ``LUNGS``.

        They passed the test of their label. The first is the lung's reference rig, whose plant is
        in :attr:`plants`. Version 1 scores that one only.
        """
        lungs = self.manifest["lungs"].values()
        return tuple(tuple(about.get("rigs", [about["session"]])) for about in lungs)

    @property
    def held_out_rigs(self) -> tuple[int | None, ...]:
        """For each lung the scored session on which no entry of ours may be trained.

        None where too few sessions passed to spare one, and in version 1.
        """
        return tuple(about.get("held_out_rig") for about in self.manifest["lungs"].values())

    @property
    def training_rigs(self) -> tuple[tuple[int, ...], ...]:
        """For each lung :attr:`rigs` without the one of :attr:`held_out_rigs`."""
        pairs = zip(self.rigs, self.held_out_rigs, strict=True)
        return tuple(tuple(rig for rig in rigs if rig != apart) for rigs, apart in pairs)

    @property
    def rejected(self) -> dict[int, str]:
        """Why a session is not scored, by its index; empty in version 1, which did not test."""
        tests = self.manifest.get("label_tests", ())
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
        """Official simulators of breaths: of their lung, on the rig that their clock tells.

        Returns:
            Plants with leaves ``(n, ...)``.

        Raises:
            InputError: if a lung is none of the recorded settings.
        """
        return self._of(breaths, np.zeros(len(breaths), np.int64))

    def cross_fitted(self, breaths: Breaths) -> Hybrid:
        """Plants of the member that has not seen each breath; of member 0 if all have seen it."""
        return self._of(breaths, np.maximum(self.seen.folds(breaths), 0))

    def held_out(self, breaths: Breaths) -> NDArray[np.bool_]:
        """Whether some member has not seen the breath, so that it can be judged by it, ``(n,)``."""
        return self.seen.folds(breaths) != BY_ALL

    def unseen(self, breaths: Breaths) -> NDArray[np.bool_]:
        """Whether the official simulators, member 0, have not seen the breath, ``(n,)``."""
        return np.isin(self.seen.folds(breaths), (BY_ALL, *range(1, self._count)), invert=True)

    @property
    def _count(self) -> int:
        return self.members.R.shape[0]

    def _of(self, breaths: Breaths, member: NDArray[np.int64]) -> Hybrid:
        at = self.sessions.assign(breaths)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[member, at]), self.members)

    def lungs(self) -> dict[str, dict[str, Any]]:
        """Settings and held-out errors of the lungs, by id."""
        return {name: dict(about) for name, about in self.manifest["lungs"].items()}

    def about(self) -> dict[str, Any]:
        """Version and hashes that a score states of its simulators."""
        hashes = {name: entry["sha256"] for name, entry in self.manifest["files"].items()}
        return {
            "version": self.manifest["version"],
            "kind": self.manifest["kind"],
            "manifest_sha256": self.manifest_sha256,
            "files": hashes,
        }


@dataclass(frozen=True, eq=False)
class FrozenLearned:
    """The paper's networks, trained on the same breaths, to compare with.

    Attributes:
        members: leaves ``(members, settings, ...)``, settings in the order of ``RECORDED_LUNGS``.
        seen: the breaths of the training.
    """

    members: Plant
    seen: Seen

    @property
    def plants(self) -> Plant:
        """The networks of the six lungs, leaves ``(6, ...)`` in the order of ``LUNGS``."""
        at = np.array([RECORDED_LUNGS.index(lung) for lung in LUNGS])
        return jax.tree.map(lambda leaf: leaf[0, at], self.members)

    def for_breaths(self, breaths: Breaths) -> Plant:
        """Networks of the breaths' lungs, leaves ``(n, ...)``; a network knows no rig."""
        return self._of(breaths, np.zeros(len(breaths), np.int64))

    def cross_fitted(self, breaths: Breaths) -> Plant:
        """Networks of the member that has not seen each breath; of member 0 if all have seen it."""
        return self._of(breaths, np.maximum(self.seen.folds(breaths), 0))

    def _of(self, breaths: Breaths, member: NDArray[np.int64]) -> Plant:
        ids = [lung.id for lung in RECORDED_LUNGS]
        unknown = sorted(set(breaths.lung_ids.tolist()) - set(ids))
        if unknown:
            raise InputError(
                f"no network was trained for {', '.join(unknown)}; known are {', '.join(ids)}"
            )
        at = np.array([ids.index(name) for name in breaths.lung_ids.tolist()], np.int64)
        return VmappedPlant(jax.tree.map(lambda leaf: jnp.asarray(leaf[member, at]), self.members))


def fingerprints(breaths: Breaths) -> NDArray[np.uint64]:
    """Short SHA-256 of each breath's lung and inspiratory commands, shape ``(n,)``.

    By these it is known which breaths were in the training, without keeping the breaths. The clock
    of a copy may have been estimated otherwise, and a published copy may lack its pressure.

    Commands are rounded to 1e-4 %, so that a copy that was written with fewer digits is known.
    """
    out = np.empty(len(breaths), np.uint64)
    commands = np.round(breaths.u_in * 1e4).astype("<i8")
    for i, (lung, inspiratory) in enumerate(
        zip(breaths.lung_ids, breaths.inspiratory, strict=True)
    ):
        digest = hashlib.sha256(str(lung).encode() + commands[i, inspiratory].tobytes())
        out[i] = int.from_bytes(digest.digest()[:8], "little")
    return out


def seen(breaths: Breaths, fold: NDArray[np.int64]) -> Seen:
    """Make the list; of copies of a breath, the one seen by most members decides."""
    key = fingerprints(breaths)
    order = np.lexsort((fold, key))
    first = np.append(True, np.diff(key[order]) > 0)
    kept = order[first]
    repeated = np.isin(key[kept], key[order[~first]])
    return Seen(key[kept], np.where(repeated, BY_ALL, fold[kept]).astype(np.int8))


def folder(version: int = 2) -> Path:
    """Folder of a version."""
    return data_path(f"simulators/v{version}")


def load(version: int = 2, path: Path | None = None) -> Frozen:
    """Read the official simulators and check every file against the manifest.

    Args:
        version: version of the simulators, 1 or 2.
        path: another folder, such as one that ``ventbench train simulator`` wrote.

    Raises:
        InputError: if a file is missing or is not what the manifest says.
    """
    path = path or folder(version)
    manifest = _manifest(path)
    members = load_plant(_checked(path, MEMBERS, manifest), as_array=np.asarray)
    if manifest["format"] == FORMAT:
        _checked(path, LEARNED, manifest)  # its hash is told with every score too
    return Frozen(
        path,
        manifest,
        files.sha256(path / MANIFEST),
        Sessions.from_list(manifest["sessions"]),
        members,
        _seen(path, manifest),
    )


def load_learned(version: int = 1, path: Path | None = None) -> FrozenLearned:
    """Read the networks; see :func:`load`."""
    path = path or folder(version)
    manifest = _manifest(path)
    members = load_plant(_checked(path, LEARNED, manifest), as_array=np.asarray)
    return FrozenLearned(members, _seen(path, manifest))


def _manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = tomllib.loads((path / MANIFEST).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path / MANIFEST} cannot be read: {error}") from error
    if manifest.get("format") not in (FORMAT, RIGS_FORMAT):
        raise InputError(
            f"{path / MANIFEST}, key format: {manifest.get('format')!r} is neither {FORMAT!r} nor "
            f"{RIGS_FORMAT!r}; this ventbench reads no other"
        )
    return manifest


def _checked(path: Path, name: str, manifest: dict[str, Any]) -> Path:
    try:
        digest, expected = files.sha256(path / name), manifest["files"][name]["sha256"]
    except (OSError, KeyError) as error:
        raise InputError(f"{path / name} is missing, or the manifest lacks it: {error}") from error
    if digest != expected:
        raise InputError(
            f"{path / name} has SHA-256 {digest[:16]}..., the manifest says {expected[:16]}...; "
            "it is damaged or changed: restore it, or reinstall ventbench"
        )
    return path / name


def _seen(path: Path, manifest: dict[str, Any]) -> Seen:
    with np.load(_checked(path, SEEN, manifest), allow_pickle=False) as arrays:
        return Seen(arrays["key"], arrays["fold"])
