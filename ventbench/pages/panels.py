"""Scored runs as pages show them: their numbers, and the axes of small multiples.

Numbers come from score files where given, else from the runs. A panel is one lung and PIP: pressure
above, u_in below, on one time axis: the last scored breath from its start to just after the
target's fall.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.base.text import flatten, number
from ventbench.pages.charts import Chart
from ventbench.task import protocol
from ventbench.task.metrics import bootstrap
from ventbench.trajectories import Trajectories

#: Steps of a run.
STEPS = protocol.BREATHS * protocol.BREATH_STEPS

#: Longest name that is shown; the rest of a longer one is cut.
NAME_LENGTH = 40


def check(runs: Sequence[Trajectories]) -> None:
    """Check that runs can be shown together.

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
    """Short, printable, distinct names of runs, for legends; ``cut`` ends one that was too long.

    Not escaped for any format.
    """
    names = []
    for run in runs:
        name = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in run.name)
        name = name.strip() or "unnamed"
        names.append(name if len(name) <= NAME_LENGTH else name[: NAME_LENGTH - len(cut)] + cut)
    return distinct(names)


def distinct(names: Sequence[str]) -> list[str]:
    """Names with a count behind those that were there before."""
    unique: list[str] = []
    for name in names:
        candidate, count = name, 1
        while candidate in unique:
            count += 1
            candidate = f"{name} ({count})"
        unique.append(candidate)
    return unique


def shared_tracks(runs: Sequence[Trajectories]) -> str:
    """Name the track of runs, or the tracks: ``performance and robustness tracks``."""
    tracks = list(dict.fromkeys(run.track for run in runs))
    return f"{' and '.join(tracks)} {'track' if len(tracks) == 1 else 'tracks'}"


def scored() -> Bools:
    """Scored steps of a run: inspirations of the scored breaths, shape ``(T,)``."""
    breath, phase = np.divmod(np.arange(STEPS), protocol.BREATH_STEPS)
    return np.isin(breath, protocol.SCORED_BREATHS) & (phase < protocol.INSPIRATION_STEPS)


#: Keys of a score that are shown elsewhere or say nothing about where the score comes from.
NOT_PROVENANCE = frozenset(
    ("score", "ci95", "lungs", "secondary", "secondary_missing", "failures", "timing", "values")
)


@dataclass(frozen=True)
class Scores:
    """Scores of N runs, cmH2O; NaN where a run failed."""

    overall: Floats  #: shape ``(N,)``.
    lungs: Floats  #: shape ``(N, L)``.
    cells: Floats  #: shape ``(N, L, P)``.


def collect(
    runs: Sequence[Trajectories], scores: Sequence[Mapping[str, Any]] | None = None
) -> Scores:
    """Scores of matching runs by their files, in the same order, or computed if there is none.

    Raises:
        InputError: if the files are not as many as the runs, or lack one of their lungs.
    """
    if scores is None:
        cells = np.stack([run.errors().to_numpy() for run in runs])
        lungs = cells.mean(axis=2)
        return Scores(lungs.mean(axis=1), lungs, cells)
    if len(scores) != len(runs):
        raise InputError(f"{len(scores)} scores for {len(runs)} runs; give one score for each run")
    read = [_read(run, score) for run, score in zip(runs, scores, strict=True)]
    overall, lungs, cells = (np.array(column) for column in zip(*read, strict=True))
    return Scores(overall, lungs, cells)


def draws(score: Mapping[str, Any]) -> str:
    """Mean over the published draws with its interval, cmH2O; empty if there were none."""
    robustness = score.get("draws")
    if not isinstance(robustness, Mapping):
        return ""
    name = str(score.get("name", "a run"))
    mean, limits = _number(name, robustness.get("score")), robustness.get("ci95") or ()
    if not np.isfinite(mean) or len(limits) != 2 or None in limits:
        return number(mean)
    low, high = (number(_number(name, limit)) for limit in limits)
    return f"{number(mean)} [{low}, {high}]"


def paired_draws(
    first_score: Mapping[str, Any], second_score: Mapping[str, Any]
) -> bootstrap.Summary | None:
    """Compare two scores draw by draw; None unless both have the same draws without a failure."""
    first, second = first_score.get("draws"), second_score.get("draws")
    if not (isinstance(first, Mapping) and isinstance(second, Mapping)):
        return None
    value_keys = ("score", "ci95", "values")
    settings = [
        {k: v for k, v in draws.items() if k not in value_keys} for draws in (first, second)
    ]
    if settings[0] != settings[1]:
        return None
    values = [draws.get("values") or () for draws in (first, second)]
    if len(values[0]) != len(values[1]) or None in (*values[0], *values[1]) or not len(values[0]):
        return None
    # What the draws have in common cancels.
    return bootstrap.summary(np.subtract(*np.array(values, dtype=np.float64)))


def failures(score: Mapping[str, Any]) -> list[str]:
    """Reasons why a score does not count: safety gate and failed cells, each message once."""
    failed = score.get("failures") or ()
    messages = [str(x.get("message", x)) if isinstance(x, Mapping) else str(x) for x in failed]
    unsafe = ["did not pass the safety gate"] if score.get("safe") is False else []
    return list(dict.fromkeys([*unsafe, *messages]))


def provenance(score: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Provenance of a score, as flat pairs of text; not escaped."""
    return flatten(_provenance(score))


def _provenance(value: Any) -> Any:
    if not isinstance(value, Mapping):
        return value
    return {key: _provenance(part) for key, part in value.items() if key not in NOT_PROVENANCE}


def _read(run: Trajectories, score: Mapping[str, Any]) -> tuple[float, list[float], Floats]:
    """Overall, lungs and cells of one score file; cells it does not have come from the run."""
    cells = run.errors().to_numpy(copy=True)
    lungs = []
    for i, lung in enumerate(run.lungs):
        entry = score.get("lungs", {}).get(lung)
        if not isinstance(entry, Mapping) or "score" not in entry:
            raise InputError(f"the score of {run.name!r} has no lung {lung}; is it of another run?")
        lungs.append(_number(run.name, entry["score"]))
        pips = entry.get("pips") or {}
        for j, pip in enumerate(run.pips):
            if f"{pip:g}" in pips:
                cells[i, j] = _number(run.name, pips[f"{pip:g}"])
    return _number(run.name, score.get("score")), lungs, cells


def _number(name: str, value: Any) -> float:
    """A score; null stands for a failed one."""
    if value is None:
        return np.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"the score of {name!r} holds {value!r} where a number belongs")
    return float(value)


#: Size of a picture; room left, right, top and bottom of the pressure, and of u_in below it.
WIDTH, HEIGHT = 184.0, 150.0
PRESSURE, VALVE = (25.0, 3.0, 5.0, 57.0), (25.0, 3.0, 102.0, 14.0)

#: Steps of the breath that are shown: until 0.3 s after the target's fall.
WINDOW_STEPS = round((protocol.FALL_END + 0.3) / protocol.DT)

#: The breath that is shown, counted from 0.
BREATH = max(protocol.SCORED_BREATHS)

#: Its steps in a run, and their times, s since the start of the breath.
WINDOW = slice(BREATH * protocol.BREATH_STEPS, BREATH * protocol.BREATH_STEPS + WINDOW_STEPS + 1)
TIMES = protocol.DT * np.arange(WINDOW_STEPS + 1)


def axes(target: Floats, limits: tuple[float, float]) -> tuple[Chart, Chart]:
    """Pressure and u_in of one lung and PIP in one picture, without lines yet.

    The target is that of the shown steps, cmH2O; limits are the ends of the pressure's axis.
    """
    span, marks = (0.0, float(TIMES[-1])), (float(target.min()), float(target.max()))
    pressure = Chart(
        span, limits, "", "cmH2O", "", width=WIDTH, height=HEIGHT, room=PRESSURE, marks=marks
    )
    pressure.band(0.0, protocol.INSPIRATION_STEPS * protocol.DT)
    command = (0.0, protocol.U_MAX)
    valve = Chart(span, command, "", "u_in, %", "", width=WIDTH, height=HEIGHT, room=VALVE)
    return pressure, valve


def pressure_limits(target: Floats, pressures: Sequence[Floats]) -> tuple[float, float]:
    """Ends of an axis that holds all pressures, up to half the target's height beyond it."""
    bottom, top = float(target.min()), float(target.max())
    height = max(top - bottom, 1.0)
    values = np.concatenate([target.ravel(), *(pressure.ravel() for pressure in pressures)])
    values = values[np.isfinite(values)]
    high = min(float(values.max()), top + 0.5 * height)
    low = max(float(values.min()), bottom - 0.5 * height)
    return low - 0.08 * height, high + 0.08 * height


def above(chart: Chart, pressures: Sequence[Floats]) -> str:
    """The highest pressure, cmH2O, if it is above the frame; else empty."""
    highest = max(
        (float(np.max(x, initial=-np.inf, where=np.isfinite(x))) for x in pressures),
        default=-np.inf,
    )
    return f"{highest:.0f}" if highest > chart.y[1] else ""
