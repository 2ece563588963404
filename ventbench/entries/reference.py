"""What normalised scores are measured against: best attainable and best PID of every cell.

``data/bounds-v2.npz`` holds both for the nominal cells and the development draws,
with the commands that attain the bound: whoever applies them gets the same errors.
``ventbench board headroom`` makes the file again, and those of other draws.
"""

from __future__ import annotations

import functools
import io
import json
import zipfile
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from ventbench.base import compilation, files
from ventbench.base.arrays import Floats, Ints
from ventbench.base.errors import InputError
from ventbench.base.executor import Progress
from ventbench.base.resume import ARRAY, WorkFolder, fingerprint, kept_results
from ventbench.controllers.pid import PID
from ventbench.task import attainable, protocol, rollouts
from ventbench.task.attainable import second_optimum
from ventbench.task.environment import Scenario
from ventbench.task.interfaces import Plant
from ventbench.task.metrics import score as metric

#: The published file for the development draws.
FILE = "bounds-v2.npz"

#: Its SHA-256, as `ventbench board headroom` prints it: new bounds are a change of this line.
SHA256 = "6b21e912e7f3dcc153932d124ebb00a69c4561c819b3eb49d307a31a2f8df90c"

#: By how much a second optimiser may do better, cmH2O: a tenth of the least headroom.
TOLERANCE = 0.1 * metric.LEAST_HEADROOM

#: Largest file that is read, bytes.
MAX_BYTES = 20_000_000

#: How often each cell starts again from its neighbours' commands. On the draws of a round the first
#: sweep found 0.01 to 0.5 cmH2O less in 123 of 756 cells, the second 0.015 at most, a third 0.01.
SWEEPS = 2

#: P, I and D of the best PID of each lung, %/cmH2O: the 100 of rounds. What
#: :func:`ventbench.train.pid_search.best_pids` finds on the rigs of the training.
PID_GAINS = (
    (10.6, 0.065, 26.2),
    (29.1, 0.332, 0.119),
    (28.2, 9.27, 9.86),
    (0.974, 4.89, 68.9),
    (1.87, 21.4, 15.8),
    (1.96, 23.0, 0.14),
)

# Steps that the second start of a further breath opens the valve fully for.
_FEW_STEPS = 4

# Columns of a stored part before the commands.
_COLUMNS = ("attainable", "lower", "stationarity", "pid")


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference errors of L lungs, nominal cells in front of K draws, and P PIPs.

    All errors leave the first step of an inspiration out, see
    :func:`ventbench.task.metrics.score.controllable_error`.
    """

    #: hashes of the simulators, and name, commitment and number of the draws.
    about: Mapping[str, Any]
    gains: Floats  #: P, I, D of each lung's best PID, %/cmH2O, shape ``(L, 3)``.
    attainable: Floats  #: error that :attr:`commands` attain, cmH2O, shape ``(L, 1 + K, P)``.
    #: error of the rise alone, below which none can be, cmH2O, shape ``(L, 1 + K, P)``.
    lower: Floats
    #: first-order decrease that is left, cmH2O, shape ``(L, 1 + K, P)``; see
    #: :class:`ventbench.task.attainable.Attainable`.
    stationarity: Floats
    #: error of the best PID with the noise of the draw, cmH2O, shape ``(L, 1 + K, P)``.
    pid: Floats
    commands: Floats  #: of each scored inspiration, %, shape ``(L, 1 + K, P, B, COMMANDS)``.

    def normalised(self, error: ArrayLike) -> Floats:
        """Normalised score of errors over the same cells, shape ``(L, 1 + k, P)`` with k <= K."""
        error = np.asarray(error, float)
        count = error.shape[1]
        return metric.normalised(error, self.attainable[:, :count], self.pid[:, :count])

    def first(self, n: int) -> Reference:
        """Return the reference of the nominal cells and the first n draws."""
        parts = {name: getattr(self, name)[:, : 1 + n] for name in (*_COLUMNS, "commands")}
        return Reference(self.about, self.gains, **parts)

    def save(self, path: Path) -> str:
        """Write the file in one step and return its SHA-256; the same content gives one hash."""
        identity = np.array(json.dumps(dict(self.about), sort_keys=True))
        arrays: dict[str, Any] = {"about": identity, "gains": self.gains}
        arrays |= {name: getattr(self, name) for name in (*_COLUMNS, "commands")}
        # Not compressed: the bytes then depend on no version of zlib.
        files.write_atomically(path, lambda file: np.savez(file, **arrays))
        return files.sha256(path)


def settings(simulators: Mapping[str, Any], draws: Mapping[str, Any] | None) -> dict[str, Any]:
    """What a reference belongs to: version and hashes of simulators, and what draws say about them.

    As JSON values; draws are None for nominal cells alone.
    """
    identity = {"simulators": simulators.get("manifest_sha256"), "draws": draws}
    return json.loads(json.dumps(identity))


def load(path: Path) -> Reference:
    """Read a file of :meth:`Reference.save`; InputError if it is missing or is not such a file."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path} is larger than {MAX_BYTES / 1e6:g} MB")
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as npz:
            identity = json.loads(str(npz["about"]))
            arrays = {name: npz[name] for name in ("gains", *_COLUMNS, "commands")}
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise
        # numpy takes whatever it does not know for a pickle.
        reason = "it is no .npz archive" if "pickle" in str(error) else error
        raise InputError(
            f"{path} is not a file of reference errors: {reason}; make it with "
            "`ventbench board headroom`"
        ) from error
    return Reference(identity, **arrays)


@functools.cache
def published() -> Reference:
    """The reference of the development draws that travels with ventbench.

    Raises:
        InputError: if it is missing, damaged, or not the published one.
    """
    path = files.data_path(FILE)
    reference = load(path)
    if files.sha256(path) != SHA256:
        raise InputError(
            f"{path} is not the published file: its SHA-256 is {files.sha256(path)}, not {SHA256}"
        )
    return reference


def reference_of(
    simulators: Mapping[str, Any], draws: Mapping[str, Any] | None, reference: Reference | None
) -> Reference | None:
    """Check that a reference belongs to simulators and draws.

    Args:
        simulators: version and hashes of the simulators.
        draws: as of :func:`settings`; the first draws of the reference's own are enough.
        reference: to be checked; the published one if not given.

    Returns:
        The reference of these draws, or None where the published one is of others.

    Raises:
        InputError: if a given reference is of other simulators or draws.
    """
    supplied = reference
    if reference is None:
        try:
            reference = published()
        except InputError:
            return None
    actual, expected = dict(reference.about), settings(simulators, draws)
    actual_draws, expected_draws = actual["draws"] or {}, expected["draws"] or {}
    keys = ("version", "sha256", "season")
    matches = actual["simulators"] == expected["simulators"] and (
        draws is None or all(actual_draws.get(key) == expected_draws.get(key) for key in keys)
    )
    count = expected_draws.get("count", 0)
    if matches and count <= actual_draws.get("count", 0):
        return reference.first(count)
    if supplied is None:
        return None
    raise InputError(
        f"the reference errors are of simulators {str(actual['simulators'])[:12]} and draws "
        f"{actual_draws}, not of {str(expected['simulators'])[:12]} and {expected_draws}; make "
        "them with `ventbench board headroom`"
    )


@jax.jit
def _pid_pressures(plants: Plant, gains: Array, cells: Scenario) -> Array:
    def run(plant: Plant, gains: Array, cells: Scenario) -> Array:
        return rollouts.closed_loop(plant, PID(*gains), cells)[0].pressure

    return jax.vmap(run)(plants, gains, cells)


def pid_errors(plants: Plant, cells: Scenario, gains: Floats) -> Floats:
    """Controllable errors of one PID a lung, cmH2O, shape of the cells.

    Args:
        plants: leaves ``(L, n, 1, ...)``.
        cells: batch shape ``(L, n, P)``.
        gains: P, I, D, %/cmH2O, shape ``(L, 3)``.
    """
    with compilation.float64():
        arrays = jax.tree.map(jnp.asarray, (plants, gains, cells))
        pressure = np.asarray(_pid_pressures(*arrays))
    return metric.controllable_error(pressure, np.asarray(cells.pip)[..., None, None])


def compute(
    plants: Plant,
    cells: Scenario,
    gains: Floats,
    identity: Mapping[str, Any],
    *,
    folder: Path,
    pool: Executor,
    progress: Progress | None = None,
) -> Reference:
    """Compute the reference errors of cells; an interrupted call continues.

    Args:
        plants: leaves ``(L, 1 + K, 1, ...)``.
        cells: batch shape ``(L, 1 + K, P)``, nominal cells first.
        gains: of each lung's best PID, %/cmH2O, shape ``(L, 3)``.
        identity: what the reference belongs to, see :func:`settings`.
        folder: for finished parts.
        pool: executor of the draws.
        progress: called with the number of cells done, and of all.

    Raises:
        InputError: if the folder holds parts of another computation, or a worker died.
    """
    lungs, draws, pips = np.shape(cells.pip)
    starts = attainable.STARTS
    keys = {"about": dict(identity), "starts": starts, "iterations": attainable.ITERATIONS}
    keys["sweeps"] = SWEEPS
    keys["inputs"] = fingerprint((plants, cells, gains))
    work = WorkFolder(folder, keys)
    report = progress or (lambda completed, total: None)
    size, total = lungs * pips, lungs * draws * pips * (1 + SWEEPS)
    parts: dict[str, Floats] = {}
    stacked = np.empty(0)
    for sweep in range(1 + SWEEPS):
        jobs: dict[str, tuple[Any, ...]] = {}
        neighbours = _neighbours(stacked) if sweep else None
        for draw in range(draws):
            draw_inputs = jax.tree.map(
                lambda x, k=draw: np.asarray(x)[:, k : k + 1], (plants, cells)
            )
            begin = starts if neighbours is None else neighbours[:, :, draw]
            jobs[f"draw-{draw}.{sweep}"] = (*draw_inputs, np.asarray(gains), begin)
        for name, part in kept_results(work, pool, _part, jobs, ARRAY):
            parts[name] = part
            report(len(parts) * size, total)
        stacked = np.stack([parts[name] for name in jobs], axis=1)
    columns = {name: stacked[..., k] for k, name in enumerate(_COLUMNS)}
    commands = stacked[..., len(_COLUMNS) :]
    commands = commands.reshape(*commands.shape[:3], len(protocol.SCORED_BREATHS), -1)
    return Reference(dict(identity), np.asarray(gains), **columns, commands=commands)


def _part(
    plants: Plant, cells: Scenario, gains: Floats, starts: tuple[int, ...] | Floats
) -> Floats:
    """Reference of one draw, shape ``(L, P, columns)``.

    Args:
        plants: of one draw, leaves ``(L, 1, 1, ...)``.
        cells: of one draw, batch shape ``(L, 1, P)``.
        gains: of :func:`compute`.
        starts: of :func:`compute`, or commands, ``(n, L, P, B, COMMANDS)``.
    """
    lungs, _, pips = np.shape(cells.pip)
    pid = pid_errors(plants, cells, gains)[:, 0]
    bounds: list[attainable.Attainable] = []
    for breath, inspirations in enumerate(_scored(plants, cells)):
        if isinstance(starts, np.ndarray):
            begin = list(starts[..., breath, :].reshape(len(starts), lungs * pips, -1))
        else:
            # Another gain moves the best commands but little: the next breath begins there.
            begin = [bounds[0].commands, _FEW_STEPS] if bounds else list(starts)
        bounds.append(attainable.attainable(*inspirations, starts=begin))
    columns = [np.mean([getattr(b, k) for b in bounds], axis=0) for k in ("error", "lower")]
    columns += [np.max([b.stationarity for b in bounds], axis=0), pid.ravel()]
    commands = np.concatenate([b.commands for b in bounds], axis=-1)
    return np.column_stack([*columns, commands]).reshape(lungs, pips, -1)


def _neighbours(stacked: Floats) -> Floats:
    """Commands to start again from, shape ``(5, L, 1 + K, P, B, COMMANDS)``.

    Cells of one lung that differ in their draw or PIP have optima that differ by little, so that a
    cell which ended in a poor local minimum has neighbours that did not: the draw whose error is
    nearest to its lower bound, the median of draws, the PIP below and the PIP above. Its best
    commands so far come first.

    Args:
        stacked: columns of all draws, ``(L, 1 + K, P, columns)``.
    """
    commands = stacked[..., len(_COLUMNS) :]
    gap = stacked[..., 0] - stacked[..., 1]
    nearest = np.argmin(gap, axis=1)[:, None, :, None]
    across = [
        np.take_along_axis(commands, nearest, axis=1),
        np.median(commands, axis=1, keepdims=True),
    ]
    pip = np.arange(commands.shape[2])
    along = [commands[:, :, np.clip(pip + step, 0, pip[-1])] for step in (-1, 1)]
    starts = np.stack([np.broadcast_to(x, commands.shape) for x in (commands, *across, *along)])
    return starts.reshape(*starts.shape[:4], len(protocol.SCORED_BREATHS), -1)


def _scored(plants: Plant, cells: Scenario) -> Iterator[tuple[Plant, Scenario]]:
    """Each scored inspiration of all cells ``(L, n, P)``, on one axis, with their plants."""
    shape = np.shape(cells.pip)
    size = int(np.prod(shape))
    flat_plants = jax.tree.map(
        lambda x: np.broadcast_to(x, (*shape, *np.shape(x)[3:])).reshape(size, *np.shape(x)[3:]),
        plants,
    )
    flat_cells = jax.tree.map(lambda x: np.asarray(x).reshape(size, *np.shape(x)[3:]), cells)
    for at in protocol.SCORED_BREATHS:
        gain, noise = flat_cells.gain[:, [at]], np.zeros((size, 1, 1))
        yield flat_plants, flat_cells.replace(gain=gain, noise=noise)


def witness_errors(reference: Reference, plants: Plant, cells: Scenario) -> Floats:
    """Errors that the commands of a reference attain, cmH2O, ``(L, 1 + K, P)``.

    Plants and cells as of :func:`compute`.
    """
    errors = []
    for breath, (flat_plants, flat_cells) in enumerate(_scored(plants, cells)):
        commands = reference.commands[..., breath, :].reshape(len(flat_cells.pip), -1)
        with compilation.float64():
            pressure = attainable.pressures(flat_plants, flat_cells, commands)
        errors.append(np.mean(np.abs(pressure - flat_cells.pip[:, None]), axis=1))
    return np.mean(errors, axis=0).reshape(np.shape(cells.pip))


def deviations(reference: Reference, plants: Plant, cells: Scenario) -> tuple[float, float]:
    """Largest difference of a bound from what its commands attain, and the same of PIDs, cmH2O."""
    attained = witness_errors(reference, plants, cells) - reference.attainable
    pid = pid_errors(plants, cells, reference.gains) - reference.pid
    return float(np.abs(attained).max()), float(np.abs(pid).max())


def second_errors(plants: Plant, cells: Scenario, index: Ints) -> Floats:
    """Least errors that the second optimiser finds in some cells, cmH2O, ``(m,)``.

    Args:
        plants: as of :func:`compute`.
        cells: as of :func:`compute`.
        index: of these cells in the flat table of all, ``(m,)``.
    """
    some = [jax.tree.map(lambda x: x[index], breath) for breath in _scored(plants, cells)]
    errors = second_optimum(*jax.tree.map(lambda *x: np.concatenate(x), *some))
    return errors.reshape(len(some), -1).mean(axis=0)


def rise_errors(plants: Plant, cells: Scenario) -> Floats:
    """Errors that no commands can be below, cmH2O, ``(L, 1 + K, P)``; arguments as of above."""
    by_breath = [attainable.rise_error(*breath) for breath in _scored(plants, cells)]
    return np.mean(by_breath, axis=0).reshape(np.shape(cells.pip))


def checked(
    reference: Reference, plants: Plant, cells: Scenario, *, every: int = 1
) -> dict[str, Any]:
    """Check a reference: its commands attain its errors, and nothing better is found by Adam.

    Plants and cells as of :func:`compute`; the second optimiser runs on one cell of ``every``.

    Returns:
        ``witness_deviation``, largest difference between an error and what its commands give;
        ``pid_deviation``, the same of the PID; ``gap_max``, largest distance to the lower bound;
        ``second_optimiser_cells``, how many it ran on, and ``second_optimiser_better_by``, its
        largest lead, all cmH2O; ``sound``, whether witnesses agree to 1e-9 and the lead is below
        :data:`TOLERANCE`.
    """
    deviation, pid_deviation = deviations(reference, plants, cells)
    index = np.arange(0, reference.pid.size, every)
    lead = reference.attainable.ravel()[index] - second_errors(plants, cells, index)
    gap = reference.attainable - reference.lower
    sound = max(deviation, pid_deviation) < 1e-9 and lead.max() < TOLERANCE and gap.min() > -1e-9
    return {
        "witness_deviation": deviation,
        "pid_deviation": pid_deviation,
        "gap_max": float(gap.max()),
        "second_optimiser_cells": len(index),
        "second_optimiser_better_by": float(lead.max()),
        "sound": bool(sound),
    }
