"""Recordings of rigs for a training: breaths, folds and labels, and arrays that the fits take."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench.base.arrays import Ints
from ventbench.base.errors import InputError
from ventbench.plants.sessions import Sessions
from ventbench.recordings import Breaths, RecordingError, join, load
from ventbench.recordings.identity import repetitions
from ventbench.task.lungs import Lung, lung

_SUFFIXES = (".csv", ".csv.gz", ".parquet")


@dataclass(frozen=True)
class RigRecordings:
    """Recordings of a training."""

    breaths: Breaths  #: n breaths, the measured ones first.
    #: number of breaths without a blank pressure, m. Reconstructed breaths have blanks, if only in
    #: their expiration.
    measured: int
    fold: Ints  #: fold of each measured breath, ``(m,)``.
    labels: tuple[Lung, ...]  #: the settings that occur, by R and C.
    sources: dict[str, dict[str, Any]]  #: SHA-256 and number of breaths of each file, by name.
    skipped: tuple[str, ...]  #: files that are not in the public schema.

    @property
    def measured_breaths(self) -> Breaths:
        """The measured breaths."""
        return self.breaths.select(np.arange(self.measured))


def load_rig_recordings(folder: Path, *, folds: int, seed: int) -> RigRecordings:
    """Read every recording of a folder that is in the public schema.

    A breath that is there twice counts once, whatever its digits. Breaths with the same commands
    and other pressures are repeats: all count, and they are in one fold. Breaths get new ids, in
    order.

    Args:
        folder: folder with ``.csv``, ``.csv.gz`` and ``.parquet`` files.
        folds: folds of the cross-validation.
        seed: seed of the folds.

    Raises:
        InputError: if a recording is malformed, or there are too few measured breaths.
        OSError: if a file cannot be read.
    """
    parts, sources, skipped = [], {}, []
    for path in sorted(folder.iterdir()):
        if not path.name.lower().endswith(_SUFFIXES):
            continue
        try:
            part = load(path)
        except RecordingError as error:
            if not _is_foreign_schema(error):
                raise
            skipped.append(path.name)
            continue
        parts.append(part)
        sources[path.name] = {"sha256": part.sha256, "breaths": len(part)}
    if not parts:
        raise InputError(
            f"{folder} holds no recording in the public schema; put CSV or Parquet files with the "
            "columns id,breath_id,R,C,time_step,u_in,u_out,pressure there"
        )
    breaths = join(parts)
    blank = breaths.valid & ~np.isfinite(breaths.pressure)
    complete = np.count_nonzero(blank, axis=1) == 0
    usable = (breaths.inspiratory & np.isfinite(breaths.pressure))[:, 1:].any(axis=1)
    order = np.concatenate([np.flatnonzero(complete & usable), np.flatnonzero(~complete & usable)])
    breaths, complete = breaths.select(order), complete[order]
    copy, repeat = repetitions(breaths)
    first = np.flatnonzero(copy == np.arange(len(copy)))
    breaths, count = breaths.select(first), int(np.count_nonzero(complete[first]))
    breaths = replace(breaths, breath_id=np.arange(1, len(first) + 1))
    if count < 2 * folds:
        raise InputError(
            f"{folder} holds {count} breaths without a blank pressure; {2 * folds} or more "
            f"are needed, two for each of {folds} folds"
        )
    measured = breaths.select(np.arange(count))
    fold = assign_folds(measured, count=folds, seed=seed)
    fold = fold[np.searchsorted(first, repeat[first[:count]])]
    labels = tuple(sorted({lung(name) for name in breaths.lung_ids.tolist()}))
    return RigRecordings(breaths, count, fold, labels, sources, tuple(skipped))


def assign_folds(breaths: Breaths, *, count: int = 5, seed: int = 0) -> Ints:
    """Assign the breaths of each lung to the folds of a cross-validation, in turn.

    The breaths of a lung are ordered by the SHA-256 of ``{seed}:{breath_id}:{lung}``, so that the
    order in which they come does not matter.

    Args:
        breaths: ids must differ.
        count: number of folds, at least 2.
        seed: any whole number.

    Returns:
        Fold of each breath, 0 to ``count - 1``, shape ``(n,)``.

    Raises:
        InputError: if there are fewer than two folds, or an id occurs twice.
    """
    if count < 2:
        raise InputError(f"a cross-validation needs at least 2 folds, not {count}")
    if len(np.unique(breaths.breath_id)) < len(breaths):
        raise InputError("breath ids are there more than once; give each breath an id of its own")
    fold = np.empty(len(breaths), np.int64)
    for name, index in breaths.by_lung_index.items():
        ids = breaths.breath_id[index].tolist()
        hashes = [hashlib.sha256(f"{seed}:{i}:{name}".encode()).digest() for i in ids]
        order = sorted(range(len(ids)), key=hashes.__getitem__)
        fold[index[order]] = np.arange(len(ids)) % count
    return fold


def _is_foreign_schema(error: RecordingError) -> bool:
    """Whether a file has another header, which is no mistake in a folder of mixed files."""
    return "column" in str(error).lower() and "missing" in str(error).lower()


#: Samples of an inspiration that are used; the longest in the recordings has 32.
SAMPLES = 33


@flax.struct.dataclass
class Groups:
    """Setting, kind of rig and session of each breath, as indices, shape ``(n,)``."""

    lung: Array
    rig: Array
    session: Array


@flax.struct.dataclass
class InspirationData:
    """n inspirations of S samples, float64; samples after the inspiration do not count."""

    groups: Groups  #: setting, kind of rig and session.
    start: Array  #: first pressure, cmH2O, ``(n,)``; 0 where unknown.
    start_measured: Array  #: whether it was measured, ``(n,)``.
    u_in: Array  #: commands, %, ``(n, S - 1)``.
    dt: Array  #: time for which each command is held, s, ``(n, S - 1)``.
    #: pressure at the end of each command, cmH2O, ``(n, S - 1)``; 0 where it has no weight.
    pressure: Array
    #: weight of each pressure in the mean of its breath, ``(n, S - 1)``; the weights of a breath
    #: add up to one.
    share: Array


def groups_of(breaths: Breaths, sessions: Sessions, labels: Sequence[Lung]) -> Groups:
    """Setting, kind of rig and session of each breath; settings are numbered as in ``labels``.

    Raises:
        InputError: a lung was never recorded.
    """
    return _groups(sessions.assign(breaths), breaths.lung_ids.tolist(), sessions, labels)


def groups_of_sessions(sessions: Sessions, labels: Sequence[Lung]) -> Groups:
    """Groups of one breath of each session, to build the sessions' plants."""
    names = [session.lung for session in sessions.table]
    return _groups(np.arange(len(sessions)), names, sessions, labels)


def _groups(
    session: Ints, lungs: Sequence[str], sessions: Sessions, labels: Sequence[Lung]
) -> Groups:
    ids = [lung.id for lung in labels]
    lung = np.array([ids.index(name) for name in lungs], np.int64)
    return Groups(*map(jnp.asarray, (lung, sessions.rigs()[session], session)))


def inspirations(
    breaths: Breaths, sessions: Sessions, labels: Sequence[Lung], samples: int = SAMPLES
) -> InspirationData:
    """Arrange breaths for the fit; the pressure of each inspiratory sample but the first counts.

    Args:
        breaths: n breaths.
        sessions: sessions by whose sampling times breaths belong together.
        labels: the settings, as they are numbered.
        samples: samples of an inspiration that are used.

    Raises:
        InputError: as :func:`groups_of`, or a breath has no pressure to learn from, or too few
            samples.
    """
    if breaths.pressure.shape[1] < 2:
        raise InputError("breaths of one sample hold nothing to learn")
    counted = breaths.inspiratory & np.isfinite(breaths.pressure)
    counted[:, 0] = False
    counted = _first(counted, False, samples)[:, 1:]
    total = counted.sum(axis=1, keepdims=True)
    if not total.all():
        number = int(np.flatnonzero(total == 0)[0])
        raise InputError(f"breath {breaths.breath_id[number]} has no inspiratory pressure to fit")
    start = breaths.pressure[:, 0]
    pressure = _first(breaths.pressure, np.nan, samples)[:, 1:]
    arrays = {
        "start": np.nan_to_num(start),
        "start_measured": np.isfinite(start) * 1.0,
        "u_in": _first(breaths.u_in, 0.0, samples)[:, :-1],
        "dt": _first(breaths.dt, 0.03, samples)[:, :-1],
        "pressure": np.where(counted, pressure, 0.0),
        "share": counted / total,
    }
    return InspirationData(
        groups_of(breaths, sessions, labels),
        **{name: jnp.asarray(value, float) for name, value in arrays.items()},
    )


@flax.struct.dataclass
class WholeBreaths:
    """n measured breaths of T samples, float64; pressure 0 where none is known."""

    groups: Groups  #: setting, kind of rig and session.
    pressure: Array  #: cmH2O, shape ``(n, T)``.
    u_in: Array  #: inspiratory valve, %, shape ``(n, T)``.
    u_out: Array  #: expiratory valve, 0/1, shape ``(n, T)``.
    dt: Array  #: time for which each command is held, s, shape ``(n, T)``.
    #: weight of each sample in the error of its breath, shape ``(n, T)``: the inspiration adds up
    #: to one, and so does the expiration; all 0 for a breath that cannot be used.
    share: Array


def complete_breaths(breaths: Breaths, sessions: Sessions, labels: Sequence[Lung]) -> WholeBreaths:
    """Arrange whole breaths; a breath without a first pressure or an expiration has no weight."""
    finite = breaths.valid & np.isfinite(breaths.pressure)
    opened = finite & (breaths.u_out == 1)
    usable = finite[:, :1] & opened.any(axis=1, keepdims=True)
    share = np.zeros(finite.shape)
    for part in (opened, finite & (breaths.u_out == 0)):
        share += usable * part / np.maximum(part.sum(axis=1, keepdims=True), 1)
    arrays = (np.nan_to_num(breaths.pressure), breaths.u_in, breaths.u_out, breaths.dt, share)
    return WholeBreaths(
        groups_of(breaths, sessions, labels), *(jnp.asarray(array, float) for array in arrays)
    )


def _first(values: NDArray, fill: float, samples: int) -> NDArray:
    """The first samples, padded to ``samples``."""
    missing = max(0, samples - values.shape[1])
    padded = np.pad(values, ((0, 0), (0, missing)), constant_values=fill)
    return padded[:, :samples]
