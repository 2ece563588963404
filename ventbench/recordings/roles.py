"""Whether columns are what they are called: roles against the physics of a ventilated lung.

Every figure is one number a breath. The sign of the flow needs no valve: over whole breaths a
ventilator does work on a passive lung, so that pressure and flow correlate; where they do the
opposite, flow is counted from the patient.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ventbench.base.arrays import Bools, Columns, Floats, Pieces
from ventbench.base.errors import InputError
from ventbench.base.linear import solve
from ventbench.recordings.bad_samples import MEASURED, notable
from ventbench.recordings.breaths import Breaths
from ventbench.recordings.headers import UNITS

SLOW = 0.5
"""Median sampling interval, s, above which times are not in seconds."""

#: Usual sampling intervals, s; shares of inspiration; PEEP and PIP, cmH2O.
_INTERVALS, _INSPIRATION, _PEEP, _PIP = (0.001, 0.05), (0.1, 0.7), (-3.0, 30.0), (5.0, 80.0)

#: Share of the breaths that must agree on a role that looks wrong.
_MOST = 0.8

#: Least range of pressure in a breath, cmH2O: below the first there is nothing to identify.
_FLAT, _MOVES = 0.02, 1.0

#: Correlation of flow and pressure below which the sign of the flow is the opposite.
OPPOSITE = -0.25

#: Share of a breath that is its end, and of its range of pressure above which it ends at its peak.
_END, _PEAK = 0.1, 0.6

#: Correlation of volume and integrated flow from which they are of one lung, and ratio from which
#: they differ more than by leaks and drifts, and from which they contradict each other.
_OF_ONE_LUNG, _DIFFERS, _CONTRADICTS = 0.9, 1.2, 1.4

#: A clock jumps over rows with a step of so many usual ones.
_JUMP = 2.5

#: Least inspiratory rows that tell whose commands pressures follow, and ratio of the variances.
_NUMBERED, _FOLLOWS = 200, 0.6

#: Saturation: fewest readings and share of them at the level, times as many as at the next level,
#: and largest step from it as a share of the range (a square wave leaves its top by a larger one).
_READINGS, _SHARE, _TIMES, _STEP = 10, 0.004, 3.0, 0.15

#: Breaths that a diagnosis and a simulator of one's own need at least.
_DIAGNOSIS, _TRAINING = 4, 10

#: Samples that are looked at together, about.
_TOGETHER = 1 << 17

#: Agreement of R and C with an exchanged label, as a ratio, and largest agreement with the label.
_EXCHANGED, _HELD = 1.35, 1.6


@dataclass(frozen=True)
class Finding:
    """Something about a column that no ventilator and no lung does."""

    column: str  #: name in the schema.
    what: str  #: a phrase without a full stop.
    advice: str  #: a sentence that names the option that mends it.
    #: ``refused`` where nothing can be done with the recording, else ``suspicious``.
    level: str = "suspicious"
    value: float = float("nan")  #: the figure that shows it.

    def __str__(self) -> str:
        """The finding in one line."""
        return f"{self.what}. {self.advice}"


@dataclass(frozen=True)
class Saturation:
    """A level at which the readings of a sensor end."""

    column: str  #: ``pressure`` or ``flow``.
    level: float  #: the level, in the unit of the schema.
    upper: bool  #: whether readings end above it, else below it.
    count: int  #: readings at the level.
    share: float  #: share of all readings of the column.

    def __str__(self) -> str:
        """The saturation as a phrase."""
        unit = {"pressure": "cmH2O", "flow": "mL/s"}[self.column]
        subject = (
            "readings of pressure saturate" if self.column == "pressure" else "flow is clipped"
        )
        return f"{subject} at {self.level:.4g} {unit} in {100 * self.share:.2g} % of the samples"


def breath_figures(time: Floats, samples: Columns, breaths: Pieces) -> Columns:
    """Reduce breaths to the numbers that :func:`findings` and :func:`saturations` judge.

    Args:
        time: s, NaN where unknown, ``(m,)``.
        samples: ``pressure`` (cmH2O), ``u_in`` (%), ``u_out`` and perhaps ``flow`` (mL/s), NaN
            where blank, ``(m,)`` each.
        breaths: samples of each of k breaths.

    Returns:
        Figures by name, ``(k,)`` each; cross products of four columns, ``(k, 10)``.
    """
    lengths = breaths.lengths[breaths.owner]
    pressure, u_in = samples["pressure"], np.nan_to_num(samples["u_in"])
    inside = samples["u_out"] == 0

    def mean(values: Floats, where: Bools) -> Floats:
        where = where & np.isfinite(values)
        return _ratio(breaths.sums(np.where(where, values, 0.0)), breaths.sums(where))

    out = {
        "inspiration": breaths.sums(inside) / breaths.lengths,
        "end": mean(pressure, lengths - breaths.within <= _END * lengths),
        "inside": mean(pressure, inside),
        "outside": mean(pressure, ~inside),
        "u_in_inside": mean(u_in, inside),
        "u_in_outside": mean(u_in, ~inside),
        "u_in": np.maximum.reduceat(u_in, breaths.starts),
        "missing": _missing(time, breaths),
    }
    out |= _commands_of(time, pressure, np.where(inside, u_in, np.nan), breaths)
    for name in ("pressure", "flow"):
        if name in samples:
            for side, sign in (("high", 1.0), ("low", -1.0)):
                for key, values in _ends(sign * samples[name], breaths).items():
                    out[f"{name}_{side}{key}"] = values
            out[f"{name}_count"] = breaths.sums(np.isfinite(samples[name]))
    if "flow" in samples:
        out |= _regression(time, pressure, samples["flow"], samples.get("volume"), breaths)
    return out


def _missing(time: Floats, breaths: Pieces) -> Floats:
    """Rows that the clock of each breath jumps over."""
    steps = np.where(breaths.within > 0, np.diff(time, prepend=np.nan), np.nan)
    finite = steps[np.isfinite(steps)]
    if len(finite) == 0:
        return np.zeros(len(breaths.starts))
    usual = float(np.median(finite))
    jumps = np.where(steps > _JUMP * usual, np.round(steps / max(usual, 1e-9)) - 1.0, 0.0)
    return breaths.sums(jumps)


def _integral(time: Floats, rate: Floats, breaths: Pieces) -> Floats:
    """Integral of a rate, which ends at each sample, from the start of each breath, ``(m,)``."""
    steps = np.nan_to_num(np.diff(time, prepend=time[:1]))
    total = np.cumsum(np.where(breaths.within > 0, steps, 0.0) * rate)
    return total - total[breaths.starts][breaths.owner]


#: Breaths whose commands may stand beside a pressure: its own, the one before, the one after.
_SHIFTS = (0, -1, 1)


def _commands_of(time: Floats, pressure: Floats, u_in: Floats, breaths: Pieces) -> Columns:
    """Cross products of p = a u + b V + c over inspirations, with the commands of three breaths."""
    volume = _integral(time, np.nan_to_num(u_in), breaths)
    products = {}
    for shift in _SHIFTS:
        neighbour = np.clip(breaths.owner + shift, 0, len(breaths.starts) - 1)
        at = np.minimum(breaths.starts[neighbour] + breaths.within, len(time) - 1)
        good = neighbour == breaths.owner + shift
        good &= breaths.within < breaths.lengths[neighbour]
        good &= np.isfinite(u_in[at]) & np.isfinite(pressure) & np.isfinite(u_in)
        columns = (u_in[at], volume[at], np.ones(len(time)), pressure)
        products[f"shift{shift}"] = _cross_products(columns, good, breaths)
    return products


#: Pairs of four columns, and the place of each pair of them in a matrix.
_PAIRS, _PLACE = np.triu_indices(4), np.zeros((4, 4), int)
_PLACE[_PAIRS] = _PLACE.T[_PAIRS] = np.arange(10)


def _cross_products(columns: Sequence[Floats], use: Bools, breaths: Pieces) -> Floats:
    """Cross products of four columns ``(m,)`` over the used samples of each breath, ``(n, 10)``."""
    used = [np.where(use, column, 0.0) for column in columns]
    pairs = zip(*_PAIRS, strict=True)
    return np.stack([breaths.sums(used[i] * used[j]) for i, j in pairs], axis=1)


def _covariances(products: Floats) -> Floats:
    """Covariances ``(n, 4, 4)`` of columns, of which the third is one, by their cross products."""
    products = products[:, _PLACE]
    count = np.maximum(products[:, 2, 2], 1.0)[:, None]
    mean = products[:, 2] / count
    return products / count[..., None] - mean[:, :, None] * mean[:, None, :]


def _ends(values: Floats, breaths: Pieces) -> Columns:
    """Largest value of each breath, how often, the next one, how often, and the step to the top."""
    starts, breath = breaths.starts, breaths.owner
    with np.errstate(invalid="ignore"):
        top = np.fmax.reduceat(values, starts)
        at = values == top[breath]
        below = np.where(at, np.nan, values)
        second = np.fmax.reduceat(below, starts)
        adjacent = values == second[breath]
        steps = np.full(len(values), np.nan)
        edge = (at[1:] != at[:-1]) & (breath[1:] == breath[:-1])
        steps[1:][edge] = np.abs(values[1:] - values[:-1])[edge]
        step = np.fmin.reduceat(steps, starts)
    return {
        "": top,
        "_often": breaths.sums(at),
        "_next": breaths.sums(adjacent),
        "_step": step,
    }


def _regression(
    time: Floats,
    pressure: Floats,
    flow: Floats,
    measured: Floats | None,
    breaths: Pieces,
) -> Columns:
    """Correlation of pressure and flow, and cross products of Q, V, 1 and p (p = R Q + V / C + p0).

    With a measured volume also how many times the integrated flow it is, and their correlation.
    """
    finite = np.isfinite(pressure) & np.isfinite(flow) & np.isfinite(time)
    q = np.where(finite, flow, 0.0)
    volume = _integral(time, 0.5 * (q + np.roll(q, 1)), breaths)
    columns = [q, volume, np.ones(len(q)), pressure]
    figures = {"flow_products": _cross_products(columns, finite, breaths)}
    spread = _covariances(figures["flow_products"])
    figures["correlation"] = correlation(spread, 0, 3)
    if measured is not None:
        columns[3] = measured
        spread = _covariances(_cross_products(columns, finite & np.isfinite(measured), breaths))
        figures["volume_ratio"] = _ratio(spread[:, 1, 3], spread[:, 1, 1])
        figures["volume_correlation"] = correlation(spread, 1, 3)
    return figures


def correlation(covariances: Floats, i: int, j: int) -> Floats:
    """Correlation of two columns by covariances of k breaths, ``(k, n, n)``; NaN if one rests."""
    variances = np.maximum(covariances[:, i, i] * covariances[:, j, j], 0.0)
    return _ratio(covariances[:, i, j], np.sqrt(variances))


def _ratio(a: Floats, b: Floats) -> Floats:
    """Quotient, NaN where b is 0."""
    return np.where(b > 0, a / np.where(b > 0, b, 1.0), np.nan)


def saturations(figures: Columns) -> tuple[Saturation, ...]:
    """Levels at which sensors end: reached again and again, exactly, and left by small steps."""
    levels = []
    for name in ("pressure", "flow"):
        if not np.isfinite(figures.get(f"{name}_high", np.zeros(0))).any():
            continue
        span = np.nanmax(figures[f"{name}_high"]) + np.nanmax(figures[f"{name}_low"])
        total = figures[f"{name}_count"].sum()
        for side in ("high", "low"):
            tops = figures[f"{name}_{side}"]
            level = np.nanmax(tops)
            at = tops == level
            count, after = (figures[f"{name}_{side}_{k}"][at].sum() for k in ("often", "next"))
            steps = figures[f"{name}_{side}_step"][at]
            small = np.isfinite(steps).any() and np.nanmedian(steps) < _STEP * span
            frequent = count >= max(_READINGS, _SHARE * total) and count >= 2 * at.sum()
            if span > _FLAT and small and frequent and count >= _TIMES * after:
                signed = float(level if side == "high" else -level)
                levels.append(
                    Saturation(name, signed, side == "high", int(count), float(count / total))
                )
    return tuple(levels)


def findings(figures: Columns, interval: Floats, R: Floats, C: Floats) -> tuple[Finding, ...]:
    """What about the roles of columns contradicts physics, the worst first.

    Takes figures of k breaths, from :func:`breath_figures`, their mean sampling intervals, s, NaN
    if unknown, and labels, cmH2O/(L/s) and mL/cmH2O, ``(k,)`` each.
    """
    low, high = -figures["pressure_low"], figures["pressure_high"]
    if not np.isfinite(high).any():
        return ()
    spans = high - low
    moves = spans > _MOVES
    if np.nanmax(spans) < _FLAT:
        message = (
            f"pressure stays at {np.nanmedian(high):.4g} cmH2O, so there is nothing to identify"
        )
        advice = "Say which column is the pressure with --map NAME=pressure."
        return (Finding("pressure", message, advice, "refused", float(np.nanmedian(high))),)
    collected = [*_times(interval)]
    if _agree(figures.get("correlation", np.zeros(0)), OPPOSITE):
        message = "flow goes out while pressure is high, so it is counted from the patient"
        collected.append(
            Finding(
                "flow",
                message,
                "Pass --invert flow to `ventbench data import`.",
                "refused",
                float(np.nanmedian(figures["correlation"])),
            )
        )
    collected += _volumes(figures)
    collected += _numbering(figures, R, C)
    if missing := int(figures["missing"].sum()):
        some = int((figures["missing"] > 0).sum())
        message = f"the clock jumps over {missing} rows in {some} of {len(spans)} breaths"
        advice = "What was commanded meanwhile is unknown: leave such breaths out, or record again."
        collected.append(Finding("time_step", message, advice, value=missing))
    inverted = _agree((figures["inside"] - figures["outside"])[moves], 0.0)
    if inverted and not any(f.column == "flow" for f in collected):
        message = "pressure is higher while u_out is 1 than while it is 0, so 0 and 1 are exchanged"
        advice = "Pass --invert u_out to `ventbench data import`."
        collected.append(Finding("u_out", message, advice))
    elif not inverted:
        collected += _commands(figures)
        collected += _phases(figures, low, spans, moves)
    collected += _pressures(float(np.nanmedian(low)), float(np.nanmedian(high)))
    collected += [
        Finding(
            s.column,
            str(s),
            "What lies beyond the sensor is unknown: widen its range, or "
            "judge the other samples only.",
            value=s.level,
        )
        for s in saturations(figures)
    ]
    if not any(f.level == "refused" for f in collected):
        collected += _labels(figures, R, C)
    return tuple(sorted(collected, key=lambda f: f.level))  # what is refused comes first


def few_breaths(count: int) -> tuple[str, ...]:
    """What fewer breaths than everything needs can still be used for; none if they are enough."""
    if not 0 < count < _TRAINING:
        return ()
    use = "`ventbench data open-loop` and, with flow, `ventbench mechanics`"
    need = f"`train simulator` needs {_TRAINING}"
    if count >= _DIAGNOSIS:
        use = f"`ventbench diagnose`, {use}"
    else:
        need += f", `diagnose` {_DIAGNOSIS} of a lung"
    return (f"{count} breath{'s' if count > 1 else ''}: enough for {use} only; {need}.",)


def _agree(values: Floats, limit: float) -> bool:
    """Whether nearly all of the known values are below a limit."""
    finite = values[np.isfinite(values)]
    return len(finite) > 0 and bool((finite < limit).mean() >= _MOST)


def _times(interval: Floats) -> Iterator[Finding]:
    if not np.isfinite(interval).any():
        return
    median = float(np.nanmedian(interval))
    if _INTERVALS[0] * 0.99 <= median <= _INTERVALS[1] * 1.01:
        return
    message = f"the median sampling interval is {median:g} s"
    unit = "ms" if median > _INTERVALS[1] else "min"
    advice = f"Rates are 20 to 1000 Hz: pass --time-unit {unit} (or --rate) to "
    level = "refused" if median > SLOW else "suspicious"
    yield Finding("time_step", message, f"{advice}`ventbench data import`.", level, median)


def _volumes(figures: Columns) -> Iterator[Finding]:
    """Volume against the integral of flow: by a unit, or by any other factor."""
    ratio = figures.get("volume_ratio", np.zeros(0))
    ratio = ratio[figures.get("volume_correlation", ratio) > _OF_ONE_LUNG]
    if len(ratio) < 0.5 * len(figures["inspiration"]) or len(ratio) == 0:
        return
    factor = float(np.median(ratio))
    apart = max(factor, 1.0 / factor)
    if apart < _DIFFERS:
        return
    units = [
        f"--{role}-unit {unit}"
        for role, sense in (("flow", 1.0), ("volume", -1.0))
        for unit, size in UNITS[role].items()
        if size != 1 and abs(np.log(factor * float(size) ** -sense)) < np.log(1.1)
    ]
    message = (
        f"flow and volume contradict each other: they differ by a factor of {apart:.1f} (volume is "
        f"{factor:.3g} times the integrated flow)"
    )
    advice = f"Mend the one that is wrong by {' or '.join([*units, '--map NAME=unused'])}."
    level = "refused" if apart >= _CONTRADICTS else "suspicious"
    yield Finding("volume", message, advice, level, factor)


def _numbering(figures: Columns, R: Floats, C: Floats) -> Iterator[Finding]:
    """Pressures that follow the commands of the breath before, or after, by far better."""
    residual = dict.fromkeys(_SHIFTS, 0.0)
    rows = dict.fromkeys(_SHIFTS, 0.0)
    for *_, same_lung in _by_label(R, C):
        for shift in _SHIFTS:
            A = figures[f"shift{shift}"][same_lung].sum(axis=0)[_PLACE]
            solved = np.linalg.lstsq(A[:3, :3], A[:3, 3], rcond=1e-9)[0]
            residual[shift] += max(float(A[3, 3] - A[:3, 3] @ solved), 0.0)
            rows[shift] += A[2, 2]
    if min(rows.values()) < _NUMBERED:
        return
    variance = {shift: residual[shift] / rows[shift] for shift in _SHIFTS}
    best = min(variance, key=lambda shift: variance[shift])
    if best == 0 or variance[best] > _FOLLOWS * variance[0] or variance[0] < _MOVES**2:
        return
    which = "before" if best < 0 else "after"
    message = (
        f"pressures follow the commands of the breath {which} (to {variance[best] ** 0.5:.2g} "
        f"cmH2O, those of their own to {variance[0] ** 0.5:.2g}), so their numbers are off by one"
    )
    advice = "Put the pressures of each breath beside its own commands."
    yield Finding("breath_id", message, advice, "refused", float(best))


def _commands(figures: Columns) -> Iterator[Finding]:
    largest = float(figures["u_in"].max())
    inside, outside = figures["u_in_inside"], figures["u_in_outside"]
    if 0.0 < largest <= 1.0:
        message = f"u_in is {largest:.3g} % at most, so it looks like 0 to 1"
        advice = "Pass --u-in-unit 1 to `ventbench data import`."
        yield Finding("u_in", message, advice, value=largest)
    elif largest > 0.0 and _agree(inside - outside, 0.0):
        message = "u_in is larger while the expiratory valve is open than in inspiration"
        advice = "Say which column is the inspiratory valve with --map NAME=u_in, or pass "
        yield Finding("u_in", message, f"{advice}--invert u_in if 100 % is shut.")


def _phases(figures: Columns, low: Floats, spans: Floats, moves: Bools) -> Iterator[Finding]:
    share = float(np.nanmedian(figures["inspiration"]))
    height = _ratio(figures["end"] - low, spans)[moves]
    if _agree(-height, -_PEAK):
        message = "breaths end at their highest pressure, so their number changes at expiration"
        yield Finding("breath_id", message, "Pass --split-breaths to `ventbench data import`.")
    elif not _INSPIRATION[0] <= share <= _INSPIRATION[1]:
        message = (
            f"inspiration (u_out = 0) is {100 * share:.3g} % of a breath; 10 to 70 % are usual"
        )
        advice = "Pass --split-breaths, or say which column is the valve with --map NAME=u_out."
        yield Finding("u_out", message, advice, value=share)


def _pressures(peep: float, pip: float) -> Iterator[Finding]:
    if _PEEP[0] <= peep <= _PEEP[1] and _PIP[0] <= pip <= _PIP[1]:
        return
    message = f"PEEP {peep:.2g} and PIP {pip:.3g} cmH2O (medians) are no ventilator's"
    unit = "kPa" if pip < _PIP[0] else "Pa"
    advice = f"If the unit is another one, pass such as --pressure-unit {unit} to "
    yield Finding("pressure", message, f"{advice}`ventbench data import`.", value=pip)


def _labels(figures: Columns, R: Floats, C: Floats) -> Iterator[Finding]:
    """Labels whose R and C are exchanged, by a regression of pressure on flow and volume."""
    if "flow_products" not in figures:
        return
    for labelled_R, labelled_C, same_lung in _by_label(R, C):
        A = figures["flow_products"][same_lung].sum(axis=0)[_PLACE]
        if A[0, 0] == 0.0 or np.linalg.matrix_rank(A[:3, :3]) < 3:
            continue
        r, e, _ = solve(A[:3, :3], A[:3, 3])
        if r <= 0.0 or e <= 0.0:
            continue
        fit = np.log([1000.0 * r, 1.0 / e])
        label, swapped = np.log([labelled_R, labelled_C]), np.log([labelled_C, labelled_R])
        if np.abs(fit - swapped).max() < np.log(_EXCHANGED) and np.abs(fit - label).max() > np.log(
            _HELD
        ):
            message = (
                f"R and C look exchanged: the label is R{labelled_R:g}C{labelled_C:g}, pressure "
                f"and flow ask for R {1000.0 * r:.3g} and C {1.0 / e:.3g}"
            )
            advice = f"Pass --lung R{labelled_C:g}C{labelled_R:g} to `ventbench data import`."
            yield Finding("R", message, advice, value=float(labelled_R))


def _by_label(R: Floats, C: Floats) -> Iterator[tuple[float, float, Bools]]:
    """Each label that breaths have, and which of them have it, ``(k,)``."""
    for label in np.unique(np.stack([R, C], axis=1), axis=0):
        yield *label, (label[0] == R) & (label[1] == C)


def check_roles(breaths: Breaths) -> tuple[Finding, ...]:
    """Check the roles of columns of breaths in memory; see :func:`findings`."""
    lengths = breaths.valid.sum(axis=1)
    last = breaths.time[np.arange(len(breaths)), lengths - 1]
    return findings(_figures_of(breaths), last / np.maximum(lengths - 1, 1), breaths.R, breaths.C)


def find_saturation(breaths: Breaths) -> tuple[Saturation, ...]:
    """Find the levels at which sensors of a recording end; see :class:`Saturation`."""
    return saturations(_figures_of(breaths))


def require_roles(breaths: Breaths) -> None:
    """Refuse breaths whose columns are not what they are called, or too bad to be used.

    Raises:
        InputError: with what is wrong and the option that mends it.
    """
    notable(breaths)
    refused = [f for f in check_roles(breaths) if f.level == "refused"]
    if refused:
        raise InputError("\n".join(f"column {f.column}: {f}" for f in refused))


def _figures_of(breaths: Breaths) -> Columns:
    """Figures of breaths, some at a time since they need many arrays as large as the recording."""
    parts = []
    together = max(1, _TOGETHER // breaths.valid.shape[1])
    for first in range(0, len(breaths), together):
        some = slice(first, first + together)
        valid = breaths.valid[some]
        arrays = {name: getattr(breaths, name) for name in ("u_in", "u_out", *MEASURED)}
        flat = {name: a[some][valid] for name, a in arrays.items() if a is not None}
        parts.append(breath_figures(breaths.time[some][valid], flat, Pieces.of(valid.sum(axis=1))))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
