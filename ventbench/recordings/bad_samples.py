"""Samples that are no readings, as hypotheses against a signal that noise and physics move.

- A *mark* of missing (-99, 99.99, 32767, 0): a value that comes again and again, exactly, with no
  other value anywhere near it; or zeros beside which the signal is not near zero.
- An *isolated* reading: it lies far outside of what its neighbours on both sides span.
- A *held* reading: the last one comes again while the noise, which never rests, would have changed
  it. If all readings are held for the same time, the sensor is slower than the rows.

What is found is listed and left out. A level at which a sensor ends is another matter, since values
come near it: see :func:`~ventbench.recordings.roles.saturations`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ventbench.base.arrays import Bools, Columns, Floats, Ints, runs
from ventbench.base.errors import InputError
from ventbench.recordings.breaths import Breaths, arranged
from ventbench.recordings.schema import COLUMNS

#: Columns that are measured.
MEASURED = ("pressure", "flow", "volume")

#: Share of the span of the pressure within which it rests: less is creep, or noise.
_RESTS = 0.05

#: Fewest readings by which the nature of a signal shows, and fewest different ones.
_READINGS, _DISTINCT = 100, 20

#: A mark comes at least so often, in at most this share of the readings, and no other value is
#: nearer than this share of the signal's inner range (from its 5th to its 95th percentile).
_AGAIN, _MOST, _APART = 3, 0.2, 0.1

#: An isolated reading leaves what its neighbours span by so many times that span, so many standard
#: deviations of the noise, and this share of the inner range.
_SPANS, _DEVIATIONS, _RANGE = 4.0, 12.0, 0.03

#: Samples on either side whose reversals tell how large those of the signal are.
_AROUND = 10

#: Standard deviations of the noise from which on a neighbour of a zero is not near zero.
_AWAY = 4.0

#: Times that isolated readings are looked for, as those that are found are no neighbours.
_PASSES = 3

#: Expected number of runs of equal readings by chance below which a run is held.
_CHANCE = 1e-3

#: Share of equal steps between changes from which a sensor is slower than the rows.
_REGULAR = 0.8

#: Share of the readings of a column that may be left out before an answer says so first, and before
#: the recording is unusable.
_NOTABLE, UNUSABLE = 0.01, 0.2

#: Places of bad samples that are shown.
_SHOWN = 5


@dataclass(frozen=True, eq=False)
class BadSamples:
    """Samples of one column that are left out for one reason."""

    column: str  #: name in the schema.
    kind: str  #: ``mark``, ``isolated``, ``held`` or ``slow``.
    rows: Ints  #: rows, ``(k,)``.
    values: Floats  #: what stands there, in the unit of the file, ``(k,)``.
    of: int  #: readings of the column in all.

    @property
    def share(self) -> float:
        """Share of the readings of the column."""
        return len(self.rows) / self.of

    def what(self, place: str = "rows", first: Sequence[int] | None = None) -> str:
        """What was left out, in words; ``first`` are the first places, else rows from 1."""
        count, listed = len(self.rows), first or [int(row) + 1 for row in self.rows[:_SHOWN]]
        where = f"{place} {', '.join(map(str, listed[:_SHOWN]))}{', ...' if count > _SHOWN else ''}"
        if self.kind == "slow":
            return (
                f"{self.column} changes in one of {self.of / (self.of - count):.0f} rows only, so "
                f"it is read more slowly than it is written: the {count} values that only repeat "
                "were left out"
            )
        why = {
            "mark": f"are {self.values[0]:g}, which stands for a missing value",
            "isolated": "are supported by no neighbour (such as "
            + ", ".join(f"{value:g}" for value in self.values[:3])
            + ")",
            "held": "only repeat the one before while the noise rests",
        }[self.kind]
        of = f"{count} of {self.of} readings of {self.column} ({100.0 * self.share:.2g} %)"
        return f"{of} {why}: {where}; they were left out"


def find_bad_samples(
    columns: Columns, missing: Collection[float] = (), schema: Columns | None = None
) -> tuple[BadSamples, ...]:
    """Find the samples of a recording that are no readings.

    Args:
        columns: those of :data:`MEASURED` that there are, and perhaps ``u_in``, in any unit and in
            the order of time, NaN where blank, ``(m,)`` each.
        missing: values that stand for a missing one, whatever their neighbours say.
        schema: the columns in the units of the schema, whose ranges few readings may leave; such a
            reading is refused if this is not given.

    Returns:
        What is to be left out, by column.
    """
    collected: list[BadSamples] = []
    cleaned: Columns = {}
    for name in (name for name in MEASURED if name in columns):
        values = np.asarray(columns[name], float)
        every = int(np.isfinite(values).sum())
        bad = np.zeros(len(values), bool)

        def add(kind: str, where: Bools) -> None:
            rows = np.flatnonzero(where & ~bad)  # noqa: B023
            if len(rows):
                bad[rows] = True  # noqa: B023
                collected.append(BadSamples(name, kind, rows, values[rows], every))  # noqa: B023

        for value in missing:
            add("mark", np.isclose(values, value, rtol=1e-6, atol=0.0))
        rest = np.where(bad, np.nan, values)
        if np.isfinite(rest).sum() >= _READINGS:
            signal = _Signal.of(rest)
            for value in signal.marks:
                add("mark", values == value)
            if signal.is_slow:
                add("slow", _repeats(values))
            else:
                if name != "volume":  # which begins at zero
                    add("mark", signal.zeros())
                isolated = signal.isolated(bad)
                if "u_in" in columns:
                    isolated &= ~_pulses(columns["u_in"])
                add("isolated", isolated)
        if schema and (out := COLUMNS[name].outside(schema[name]) & ~bad).mean() <= _NOTABLE:
            add("isolated", out)
        cleaned[name] = np.where(bad, np.nan, values)
    held = _held(cleaned)
    return (*collected, *held)


def blanked(columns: Columns, bad: Iterable[BadSamples]) -> Columns:
    """The columns with NaN in place of bad samples."""
    out = dict(columns)
    for samples in bad:
        values = out[samples.column].astype(float)
        values[samples.rows] = np.nan
        out[samples.column] = values
    return out


def left_out(bad: Iterable[BadSamples]) -> dict[str, float]:
    """Share of the readings of each column that are none; those of a slow sensor do not count."""
    shares = defaultdict[str, float](float)
    for samples in bad:
        if samples.kind != "slow":
            shares[samples.column] += samples.share
    return shares


def notable(breaths: Breaths) -> str | None:
    """What an answer says first: the share that was left out, without a full stop; None if few.

    Raises:
        InputError: if it is so large that the recording is unusable.
    """
    column, share = max(breaths.left_out.items(), key=lambda pair: pair[1], default=("", 0.0))
    text = f"{100.0 * share:.2g} % of the readings of {column} are none and are left out"
    if share > UNUSABLE:
        raise InputError(f"column {column}: {text}. That is too much: the recording is unusable.")
    return text if share > _NOTABLE else None


def clean(breaths: Breaths, missing: Collection[float] = ()) -> Breaths:
    """Breaths without bad samples, which its notes list first; the same object if there is none.

    Args:
        breaths: the recording.
        missing: see :func:`find_bad_samples`.
    """
    arrays = {name: getattr(breaths, name) for name in (*MEASURED, "u_in")}
    columns = {name: x[breaths.valid] for name, x in arrays.items() if x is not None}
    bad = find_bad_samples(columns, missing)
    if not bad:
        return breaths
    cleaned, changes = blanked(columns, bad), {}
    for name in {samples.column for samples in bad}:
        changes[name] = np.full(breaths.valid.shape, np.nan)
        changes[name][breaths.valid] = cleaned[name]
    notes = (*(samples.what().capitalize() + "." for samples in bad), *breaths.notes)
    shares = dict(Counter(left_out(bad)) + Counter(breaths.left_out))
    return replace(breaths, notes=notes, left_out=shares, **changes)


def at_the_slowest(breaths: Breaths) -> Breaths:
    """Breaths at the readings of the column that comes most slowly, where one does, and evenly.

    Others that were read in rows of their own are interpolated there. The slowest would lag behind
    the others between its readings, where it jumps.
    """
    columns = {name: x for name in MEASURED if (x := getattr(breaths, name)) is not None}
    slowest = min(columns.values(), key=lambda x: np.isfinite(x).sum())
    known = breaths.valid & np.isfinite(slowest)
    rows, lengths = np.flatnonzero(known[breaths.valid]), known.sum(axis=1)
    apart = np.diff(rows)
    if min(lengths) < 2 or (usual := np.median(apart)) < 2 or np.quantile(apart, 0.95) > 2 * usual:
        return breaths
    first = breaths.time[np.arange(len(breaths)), known.argmax(axis=1)]
    clock = np.append(0.0, np.cumsum(breaths.dt[breaths.valid]))
    samples = {name: getattr(breaths, name)[known] for name in ("u_in", "u_out")}
    for name, x in columns.items():
        values = x[breaths.valid]
        at = np.flatnonzero(np.isfinite(values))
        after = np.searchsorted(at, rows).clip(1, len(at) - 1)
        near = np.isfinite(values[rows]) | (at[after] - at[after - 1] <= 2 * usual)
        between = np.interp(clock[rows], clock[at], values[at])
        samples[name] = np.where(near, between, np.nan)
    kept = ("breath_id", "R", "C", "source", "left_out")
    rest = {name: getattr(breaths, name) for name in kept}
    note = (
        f"{breaths.valid.sum() - len(rows)} rows in which only some of the measured columns "
        "are known were left out; short blanks in the others are interpolated."
    )
    rest["notes"] = (*breaths.notes, note)
    return arranged(lengths, (breaths.time - first[:, None])[known], samples, **rest)


@dataclass(frozen=True)
class _Signal:
    """The readings of a column, and what they are like."""

    values: Floats  #: ``(m,)``.
    span: float  #: inner range.
    noise: float  #: standard deviation of the noise, of which curvature is part.
    resolution: float  #: usual step between neighbouring values.
    marks: tuple[float, ...]  #: values that stand for missing ones.

    @classmethod
    def of(cls, values: Floats) -> _Signal:
        finite = values[np.isfinite(values)]
        low, high = np.quantile(finite, [0.05, 0.95])
        kinds, counts = np.unique(finite, return_counts=True)
        gaps = np.diff(kinds, prepend=-np.inf, append=np.inf)
        apart = np.minimum(gaps[1:], gaps[:-1]) > _APART * max(high - low, 1e-12)
        often = (counts >= _AGAIN) & (counts <= _MOST * len(finite))
        distinct = len(kinds) >= _DISTINCT and high > low
        marks = tuple(kinds[apart & often].tolist()) if distinct else ()
        good = finite[~np.isin(finite, marks)] if marks else finite
        inner = gaps[1:-1][(kinds[1:] > low) & (kinds[1:] < high)]
        resolution = float(np.median(inner)) if len(inner) else 0.0
        return cls(values, float(high - low), noise_of(good), resolution, marks)

    def isolated(self, bad: Bools) -> Bools:
        """Samples far outside of what the three on both sides of them span, but one of them.

        So are those from which the signal comes back much farther than between the others. Zeros
        that follow one another are one sample. One that is found, or bad, hides others no more.
        """
        out = bad.copy()
        for _ in range(_PASSES if self.span > 0.0 else 0):
            left = np.isfinite(self.values) & ~out
            first = left & ~((self.values == 0.0) & _repeats(self.values))
            centre = self.values[first]
            padded = np.pad(centre, _AROUND, mode="edge")  # at an end nothing is isolated
            limit = _DEVIATIONS * self.noise + max(_RANGE * self.span, 3.0 * self.resolution)
            steps = np.abs(np.diff(centre, prepend=centre[0], append=centre[-1])) > limit
            some = np.flatnonzero(steps[1:] | steps[:-1])  # others cannot be far from five of six
            window = np.delete(np.arange(2 * _AROUND + 1), _AROUND)
            around = padded[some[:, None] + window]
            neighbours = np.sort(around[:, _AROUND - 3 : _AROUND + 3], axis=1)
            low, high = neighbours[:, 1], neighbours[:, 4]
            beyond = np.maximum(centre[some] - high, low - centre[some])
            # On an edge neighbours span much. A signal goes there and back at once where it does so
            # again and again, or goes on as fast on one of the sides.
            here = padded[some[:, None] + np.arange(_AROUND - 1, _AROUND + 2)]
            there, on = (np.abs(np.diff(values, axis=1)) for values in (here, around))
            back = (there - _SPANS * on[:, [_AROUND - 2, _AROUND]]).min(axis=1)
            others = _reversals(around).max(axis=1)
            turns = (_reversals(here)[:, 0] > 0.0) & (back > limit + _SPANS * others)
            remote = (beyond > limit + _SPANS * (high - low)) | turns
            found = np.zeros(len(centre), bool)
            found[some[remote]] = True
            remote = left & found[np.cumsum(first) - 1]
            if remote.sum() <= _MOST * left.sum():
                out |= remote
        return out

    def zeros(self) -> Bools:
        """Zeros that stand for missing values: one or two beside which nothing is near zero.

        Several must have both neighbours on one side: an edge may pass zero.
        """
        values, out = self.values, np.zeros(len(self.values), bool)
        spans = [span for span in runs(values == 0.0) if span[0] > 0 and span[1] < len(values)]
        if not spans:
            return out
        first, last = np.array(spans).T
        before, after = values[first - 1], values[last]
        far = np.minimum(np.abs(before), np.abs(after)) > _AWAY * self.noise + 3.0 * self.resolution
        far &= last - first <= 2
        if np.sum(far & (before * after > 0.0)) >= _AGAIN:
            for start, stop in zip(first[far], last[far], strict=True):
                out[start:stop] = True
        return out

    @property
    def is_slow(self) -> bool:
        """Whether the sensor is slower than the rows: its readings change at equal steps."""
        changes = np.flatnonzero(np.diff(self.values[np.isfinite(self.values)]) != 0)
        lengths = np.diff(changes)
        if len(lengths) < _READINGS // 2 or (usual := int(np.median(lengths))) < 2:
            return False
        return bool((np.abs(lengths - usual) <= (usual > 2)).mean() >= _REGULAR)


def noise_of(readings: Floats) -> float:
    """Standard deviation of the white noise of evenly spaced readings, by second differences.

    Curvature is part of it. Zero of two readings and fewer; blanks are NaN.
    """
    bends = np.abs(np.diff(readings[np.isfinite(readings)], 2))
    return 1.4826 * float(np.median(bends)) / np.sqrt(6.0) if len(bends) else 0.0


def _repeats(values: Floats) -> Bools:
    """Whether a value is exactly the one before, ``(m,)``."""
    return np.append(False, values[1:] == values[:-1])


def _reversals(values: Floats) -> Floats:
    """By how much inner values lie on one side of both neighbours; 0 if between, ``(k, m - 2)``."""
    steps = np.diff(values, axis=1)
    turns = steps[:, :-1] * steps[:, 1:] < 0.0
    return np.where(turns, np.minimum(np.abs(steps[:, :-1]), np.abs(steps[:, 1:])), 0.0)


def _pulses(u_in: Floats) -> Bools:
    """Samples just behind a strong move of a command, which a pressure may follow at once."""
    moves = np.abs(np.diff(np.nan_to_num(u_in), prepend=u_in[:1]))
    strong = moves > max(5.0, 10.0 * float(np.nanmedian(moves)))
    return strong | np.append(strong[1:], False) | np.append(False, strong[:-1])


def _held(columns: Columns) -> list[BadSamples]:
    """Runs in which all columns, or one of them, repeat while their noise would have moved them."""
    chances = {name: _chance(values) for name, values in columns.items()}
    repeats = {name: _repeats(values) for name, values in columns.items()}
    every = np.logical_and.reduce(list(repeats.values()))
    together = _improbable(every, float(np.prod(list(chances.values())))) & (len(repeats) > 1)
    collected = []
    for name, values in columns.items():
        ends = np.isin(values, [np.fmin.reduce(values), np.fmax.reduce(values)])
        if name == "flow" and "pressure" in columns:
            ends = ends | _at_rest(values, columns["pressure"])
        rows = np.flatnonzero(together | (_improbable(repeats[name], chances[name]) & ~ends))
        if len(rows):
            of = int(np.isfinite(values).sum())
            collected.append(BadSamples(name, "held", rows, values[rows], of))
    return collected


def _at_rest(flow: Floats, pressure: Floats) -> Bools:
    """Runs of no flow at all while the pressure rests, ``(m,)``: nothing moves, nothing is held."""
    out = np.zeros(len(flow), bool)
    if not np.isfinite(pressure).any():
        return out
    span = float(np.diff(np.nanquantile(pressure, [0.05, 0.95]))[0])
    for start, stop in runs(flow == 0.0):
        during = pressure[start:stop]
        out[start:stop] = np.fmax.reduce(during) - np.fmin.reduce(during) < _RESTS * span
    return out


def _improbable(repeats: Bools, chance: float) -> Bools:
    """Runs of repeats that chance does not make, ``(m,)``."""
    out = np.zeros(len(repeats), bool)
    if chance < 1.0:
        for start, stop in runs(repeats):
            if stop - start > 1 and len(repeats) * chance ** (stop - start) < _CHANCE:
                out[start:stop] = True
    return out


def _chance(values: Floats) -> float:
    """Probability that noise leaves a reading as it was.

    Differences of the fourth order hold hardly anything but noise, and those of the quietest fifth
    of the signal the least that it has.
    """
    finite = values[np.isfinite(values)]
    if len(finite) < _READINGS or np.ptp(finite) == 0.0:
        return 1.0
    kinds = np.unique(finite)
    span = float(np.diff(np.quantile(finite, [0.05, 0.95]))[0])
    step = max(float(np.quantile(np.diff(kinds), 0.05)), 1e-4 * span)
    fourth = np.abs(np.diff(finite, 4))
    moving = fourth[fourth > 0.0] if (fourth > 0.0).mean() > 0.5 else fourth
    noise = float(np.quantile(moving, 0.2)) / (0.2533 * np.sqrt(70.0))
    return min(1.0, step / (3.5 * noise)) if noise > 0.0 else 1.0


def repeated_rows(columns: Columns) -> Bools:
    """Rows that are the row before once more, ``(m,)``.

    With a clock, the time is the same too. Without one, a row may also be held while the time goes
    on: twice the usual time has then passed at the row behind. Lines through four rows on both
    sides tell which is likelier, by residuals with the tails of Cauchy's distribution.
    """
    repeats = np.logical_and.reduce([_repeats(values) for values in columns.values()])
    if "time" in columns:
        return repeats
    measured, none = [columns[name] for name in MEASURED if name in columns], repeats & False
    chance = float(np.prod([_chance(values) for values in measured]))
    if len(measured) < 2 or repeats.sum() < 10.0 * (1.0 + len(repeats) * chance):
        return none
    single = np.flatnonzero(repeats[1:-2] & ~repeats[:-3] & ~repeats[2:-1]) + 1
    single = single[(single > 3) & (single < len(repeats) - 4)]
    nats = 0.0
    for values in measured:
        around = values[single[:, None] + np.delete(np.arange(-4, 5), 4)]
        least = max(noise_of(values), 1e-9) ** 2
        for passed, sign in ((1.0, -1.0), (2.0, 1.0)):
            line = np.vander(np.append(np.arange(-3.0, 1.0), passed + np.arange(4.0)), 2)
            off = around - around @ np.linalg.pinv(line).T @ line.T
            nats += sign * float(np.nansum(np.log(least + np.sum(off**2, axis=1))))
    return repeats if nats > 0.0 else none
