"""Scored runs as pages show them: their numbers, and the geometry of small multiples.

Numbers come from score files where given, else from the runs. A panel is one lung and PIP: pressure
above, u_in below, on one time axis: the last scored breath from its start to just after the
target's fall. Lengths are in units of the panel; polylines become SVG.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ventbench.base.arrays import Bools, Floats
from ventbench.base.errors import InputError
from ventbench.base.text import flatten, number
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


def path(line: Floats) -> str:
    """Path data of a polyline ``(n, 2)``; it breaks where a point is not finite.

    Coordinates are rounded to a tenth and written relative to the point before, without drift.
    """
    tenths = np.round(line * 10.0)
    parts: list[str] = []
    before: tuple[int, int] | None = None
    for point in tenths:
        if not np.all(np.isfinite(point)):
            before = None
            continue
        x, y = int(point[0]), int(point[1])
        if before is None:
            parts.append(f"M{_tenth(x)} {_tenth(y)}")
        elif (x, y) != before:
            parts.append(_line(x - before[0], y - before[1]))
        before = x, y
    return "".join(parts)


def area(upper: Floats, lower: Floats) -> str:
    """Path data of the area between two polylines over the same x; empty where one has a gap."""
    if not (len(upper) and np.isfinite(upper).all() and np.isfinite(lower).all()):
        return ""
    return path(np.concatenate([upper, lower[::-1]])) + "z"


def _line(dx: int, dy: int) -> str:
    if dy == 0:
        return f"h{_tenth(dx)}"
    if dx == 0:
        return f"v{_tenth(dy)}"
    second = _tenth(dy)
    return f"l{_tenth(dx)}{second if second.startswith('-') else ' ' + second}"


def _tenth(value: int) -> str:
    """A number of tenths in the shortest decimal notation: 0.5 is ``.5``."""
    text = f"{value / 10:g}"
    return text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text


#: Size of a panel, and its two plots: left, top, width, height.
WIDTH, HEIGHT = 184.0, 150.0
LEFT, TOP, PLOT_WIDTH, PRESSURE_HEIGHT = 25.0, 5.0, 156.0, 88.0
VALVE_TOP, VALVE_HEIGHT = 102.0, 34.0

#: Commands that are marked on the axis of u_in, %: the same in every panel.
VALVE_MARKS = (0.0, 50.0, protocol.U_MAX)

#: Times that are marked on the axis, s.
TIMES = (0.0, 0.5, 1.0, 1.5)

#: Steps of the breath that are shown: until 0.3 s after the target's fall.
SHOWN = round((protocol.FALL_END + 0.3) / protocol.DT)

#: The breath that is shown, counted from 0.
BREATH = max(protocol.SCORED_BREATHS)

#: Its steps in a run.
WINDOW = slice(BREATH * protocol.BREATH_STEPS, BREATH * protocol.BREATH_STEPS + SHOWN + 1)


@dataclass(frozen=True)
class RunPanel:
    """One lung and PIP, in panel units (y downwards)."""

    lung: str  #: id.
    pip: float  #: cmH2O.
    ticks: tuple[tuple[float, float], ...]  #: ticks of the pressure axis, value in cmH2O and y.
    target: Floats  #: polyline, shape ``(SHOWN + 1, 2)``.
    #: one polyline a run, shape ``(SHOWN + 1, 2)``; NaN where there is no finite pressure.
    pressures: tuple[Floats, ...]
    #: one polyline a run, u_in as a staircase, shape ``(2 * SHOWN + 1, 2)``.
    valves: tuple[Floats, ...]
    above: float | None  #: highest pressure of the first run if that is above the frame, cmH2O.


def panels(runs: Sequence[Trajectories]) -> list[list[RunPanel]]:
    """All panels, a row a lung; axes are the same down a column (one PIP)."""
    columns = [_column(runs, j) for j in range(len(runs[0].pips))]
    return [list(row) for row in zip(*columns, strict=True)]


def time_x(seconds: Floats | float) -> Floats:
    """Horizontal position of a time since the start of the breath, panel units."""
    return LEFT + np.asarray(seconds) / (SHOWN * protocol.DT) * PLOT_WIDTH


def inspiration(line: Floats) -> Floats:
    """Part of a pressure polyline that is scored."""
    return line[: protocol.INSPIRATION_STEPS]


def _column(runs: Sequence[Trajectories], j: int) -> list[RunPanel]:
    pip, window = runs[0].pips[j], WINDOW
    x = time_x(sample_times())
    low, high = pressure_limits(runs, j)

    def y(pressure: Floats | float) -> Floats:
        return TOP + (high - np.asarray(pressure)) / (high - low) * PRESSURE_HEIGHT

    def line(pressure: Floats) -> Floats:
        inside = np.clip(pressure, low - (high - low), high + (high - low))
        return np.stack([x, np.where(np.isfinite(pressure), y(inside), np.nan)], axis=-1)

    column = []
    for i, lung in enumerate(runs[0].lungs):
        pressures = [run.pressure[i, j, window] for run in runs]
        finite = pressures[0][np.isfinite(pressures[0])]
        highest = float(finite.max(initial=-np.inf))
        target = runs[0].target[i, j, window]
        marks = (float(target.min()), pip)
        column.append(
            RunPanel(
                lung=lung,
                pip=pip,
                ticks=tuple((value, float(y(value))) for value in marks),
                target=line(target),
                pressures=tuple(line(pressure) for pressure in pressures),
                valves=tuple(_stairs(x, run.u_in[i, j, window]) for run in runs),
                above=highest if highest > high else None,
            )
        )
    return column


def sample_times() -> Floats:
    """Times of the samples that are shown, s since the start of the breath, ``(SHOWN + 1,)``."""
    return np.arange(SHOWN + 1, dtype=np.float64) * protocol.DT


def pressure_limits(runs: Sequence[Trajectories], j: int) -> tuple[float, float]:
    """Pressure axis of a PIP: holds all runs, up to half the target's height beyond it."""
    target = runs[0].target[:, j, WINDOW]
    bottom, top = float(target.min()), float(target.max())
    height = max(top - bottom, 1.0)
    values = np.concatenate([run.pressure[:, j, WINDOW].ravel() for run in runs])
    values = values[np.isfinite(values)]
    high = min(float(values.max(initial=top)), top + 0.5 * height)
    low = max(float(values.min(initial=bottom)), bottom - 0.5 * height)
    return low - 0.08 * height, high + 0.08 * height


def valve_y(u_in: Floats | float) -> Floats:
    """Vertical position of a command, %, panel units."""
    return VALVE_TOP + (1.0 - np.asarray(u_in) / protocol.U_MAX) * VALVE_HEIGHT


def _stairs(x: Floats, u_in: Floats) -> Floats:
    """A command holds until the next step."""
    y = valve_y(np.where(np.isfinite(u_in), np.clip(u_in, 0.0, protocol.U_MAX), np.nan))
    return np.stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]], axis=-1)
