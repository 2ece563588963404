"""Runs in pictures: checks that they match, their names and their errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ventbench.base.errors import InputError
from ventbench.task import protocol
from ventbench.task.metrics.score import run_error
from ventbench.trajectories import Trajectories

Floats = NDArray[np.float64]

#: Steps of a run.
STEPS = protocol.BREATHS * protocol.BREATH_STEPS

#: Longest name that is shown; the rest of a longer one is cut.
NAME_LENGTH = 40


def check(runs: Sequence[Trajectories]) -> None:
    """Check that runs can be shown together.

    Args:
        runs: any number.

    Raises:
        InputError: if there is none, one has arrays of a wrong shape, or they differ in
            lungs, PIPs or times.
    """
    if not runs:
        raise InputError("there is no run to show; give at least one")
    first = runs[0]
    if not (first.lungs and first.pips):
        raise InputError(f"run {first.name!r} is empty: it has no lung or no PIP")
    for run in runs:
        if run.time.shape != (STEPS,):
            raise InputError(
                f"run {run.name!r} has times of shape {run.time.shape}; "
                f"a run of the protocol has {STEPS} steps"
            )
        shape = (len(run.lungs), len(run.pips), STEPS)
        for key in ("target", "pressure", "u_in", "u_out"):
            if getattr(run, key).shape != shape:
                raise InputError(
                    f"run {run.name!r}: {key} has shape {getattr(run, key).shape}, "
                    f"not {shape} (lungs, PIPs, steps)"
                )
        for key in ("lungs", "pips"):
            if getattr(run, key) != getattr(first, key):
                raise InputError(
                    f"run {run.name!r} has {key} {getattr(run, key)}, but {first.name!r} has "
                    f"{getattr(first, key)}; show runs of the same protocol together"
                )
        if not np.allclose(run.time, first.time, atol=1e-6):
            raise InputError(f"run {run.name!r} has other times than {first.name!r}")


def labels(runs: Sequence[Trajectories], cut: str = "…") -> list[str]:
    """Short, printable, distinct names of runs, for legends; not escaped for any format.

    Args:
        runs: any number.
        cut: ends a name that was too long.
    """
    names = []
    for run in runs:
        name = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in run.name)
        name = name.strip() or "unnamed"
        names.append(name if len(name) <= NAME_LENGTH else name[: NAME_LENGTH - len(cut)] + cut)
    return distinct(names)


def distinct(names: Sequence[str]) -> list[str]:
    """Names with a count behind those that were there before."""
    seen: list[str] = []
    for name in names:
        candidate, count = name, 1
        while candidate in seen:
            count += 1
            candidate = f"{name} ({count})"
        seen.append(candidate)
    return seen


def shared_tracks(runs: Sequence[Trajectories]) -> str:
    """Name the track of runs, or the tracks: ``performance and robustness tracks``."""
    tracks = list(dict.fromkeys(run.track for run in runs))
    return f"{' and '.join(tracks)} {'track' if len(tracks) == 1 else 'tracks'}"


def scored() -> NDArray[np.bool_]:
    """Scored steps of a run: inspirations of the scored breaths, shape ``(T,)``."""
    breath, phase = np.divmod(np.arange(STEPS), protocol.BREATH_STEPS)
    return np.isin(breath, protocol.SCORED_BREATHS) & (phase < protocol.INSPIRATION_STEPS)


def errors(run: Trajectories) -> Floats:
    """Mean absolute error over the scored steps, cmH2O, shape ``(L, P)``.

    NaN where a scored pressure is not finite: such a cell failed.
    """
    shape = (*run.pressure.shape[:-1], protocol.BREATHS, protocol.BREATH_STEPS)
    pressure, target = (
        x.reshape(shape)[..., : protocol.INSPIRATION_STEPS] for x in (run.pressure, run.target)
    )
    return run_error(np.where(np.isfinite(pressure), pressure, np.nan), target)
