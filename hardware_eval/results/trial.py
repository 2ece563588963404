"""What a session says as a trial: scores, gaps and rank agreement with 95 % intervals.

Three levels scatter. Repeats of one lung at one PIP differ; so do mountings of one lung, by supply,
temperature and tubes; PIPs are those of the protocol and count as fixed. Two intervals follow:

- *as mounted*: of the mean over these lungs as they stood. The variances of the cells' means add;
  Student's t with the degrees of freedom of Welch and Satterthwaite.
- *mounted anew*: of the gap, mean over lungs, if the lungs were set again. A lung's gap to the
  simulation has the scatter of its mounting and of its repeats in it, so that the standard
  deviation between lungs holds all levels (the mixed model's interval in a balanced design): t with
  one degree of freedom less than there are mountings. What simulators miss of each lung counts as
  scatter too, which makes it wide.

Rank agreement is between the order in simulation and on the bench. Its interval is that of draws of
all entries' means together, each with the distribution of *mounted anew*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from hardware_eval.bench.identity import interval
from hardware_eval.bench.raw_log import read_session
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.interval import Interval

#: Draws of the interval of rank agreement, and their seed.
DRAWS, SEED = 1000, 0


def with_error(errors: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean over cells of repeats, its standard error and degrees of freedom, ``(...)`` each.

    Errors have shape ``(..., cells, repeats)``; of one repeat there is no standard error, with no
    degree of freedom. Where none differs it is 0. Mountings are the repeats of one cell where the
    lungs are mounted anew.
    """
    *_, cells, repeats = errors.shape
    mean = errors.mean(axis=(-1, -2))
    if repeats < 2:
        return mean, np.full(mean.shape, np.nan), np.zeros(mean.shape)
    variance = errors.var(axis=-1, ddof=1) / repeats / cells**2
    total = variance.sum(axis=-1)
    freedom = total**2 / np.maximum((variance**2).sum(axis=-1) / (repeats - 1), 1e-300)
    return mean, np.sqrt(total), np.maximum(freedom, 1.0)


#: Rank correlations of two orders, by the names of a trial.
CORRELATIONS: dict[str, Any] = {"kendall": stats.kendalltau, "spearman": stats.spearmanr}


def correlation(name: str, simulated: Floats, measured: Floats) -> float:
    """One of :data:`CORRELATIONS`; 0 where all entries are alike, which has none."""
    alike = min(np.ptp(simulated), np.ptp(measured)) == 0.0
    return 0.0 if alike else float(CORRELATIONS[name](simulated, measured).statistic)


def agreement(simulated: Floats, measured: Floats, *, draws: int = DRAWS) -> dict[str, Interval]:
    """Rank agreement of entries in simulation and on the bench, ``kendall`` and ``spearman``.

    The drawn means share their mountings, so that what a mounting does to all entries changes no
    order: a multivariate t about the measured means, with the covariance of the gaps.

    Args:
        simulated: score of each entry and mounting in simulation, ``(E, M)``, two entries at least.
        measured: on the bench, ``(E, M)``; with one mounting there is no interval.
        draws: number of draws.
    """
    mountings = measured.shape[1]
    own, means = simulated.mean(axis=1), measured.mean(axis=1)
    drawn = means[None]
    if mountings > 1:
        random = np.random.default_rng(SEED)
        off = measured - simulated
        off = off - off.mean(axis=1, keepdims=True)
        normal = random.standard_normal((draws, mountings)) / math.sqrt(mountings)
        scale = np.sqrt(random.chisquare(mountings - 1, (draws, 1)))
        drawn = means + normal / scale @ off.T
    found = {}
    for name in CORRELATIONS:
        each = [correlation(name, own, one) for one in drawn]
        ends = np.quantile(each, (0.025, 0.975)).tolist() if mountings > 1 else ()
        found[name] = Interval(correlation(name, own, means), *ends)
    return found


@dataclass(frozen=True)
class EntryTrial:
    """What a trial says of one entry."""

    score: Interval  #: mean error, cmH2O, as mounted; NaN if a run failed.
    scores: dict[str, Interval]  #: the same by mounting.
    simulated: dict[str, float]  #: mean error in the dry run by mounting, cmH2O; NaN without one.
    #: mean error less that in simulation, cmH2O, mounted anew; NaN without a dry run.
    gap: Interval
    gaps: dict[str, Interval]  #: the same by mounting, cmH2O, as mounted.
    success: Interval  #: share of scored runs that completed, by Clopper and Pearson.
    successes: dict[str, tuple[int, int]]  #: completed scored runs and all of them, by mounting.
    repeat_sd: float  #: standard deviation of repeats, pooled, cmH2O.
    mounting_sd: float  #: standard deviation of the gap between mountings beyond that, cmH2O.

    @property
    def runs(self) -> tuple[int, int]:
        """Completed scored runs, and all of them."""
        completed, runs = zip(*self.successes.values(), strict=True)
        return sum(completed), sum(runs)


@dataclass(frozen=True)
class Trial:
    """What the sessions of a trial say."""

    entries: dict[str, EntryTrial]  #: by name.
    #: rank agreement of the entries with a score; empty for fewer than two.
    agreement: dict[str, Interval]
    missing: tuple[str, ...]  #: why something could not be said.

    def __str__(self) -> str:
        rows = []
        for name, x in self.entries.items():
            done, runs = x.runs
            rows.append(
                f"{name}: error {x.score} cmH2O as mounted; {done} of {runs} runs succeeded "
                f"({x.success.low:.1%} to {x.success.high:.1%})"
            )
            rows.append(
                f"  gap to simulation {x.gap} cmH2O mounted anew; SD of repeats "
                f"{Interval(x.repeat_sd)}, of mountings {Interval(x.mounting_sd)}"
            )
            for mounting, gap in x.gaps.items():
                succeeded, of = x.successes[mounting]
                rows.append(f"  {mounting}: gap {gap}, {succeeded} of {of} succeeded")
        rows += [f"rank agreement, {name}: {value}" for name, value in self.agreement.items()]
        return "\n".join([*rows, *self.missing])


def analyse(logs: Sequence[Path]) -> Trial:
    """Analyse the sessions of a trial, each of which mounts each of its lungs once.

    Args:
        logs: logs of finished plans with the same entries and PIPs, or their folders.

    Raises:
        InputError: if a log holds no plan, is not finished, or is of another trial.
    """
    names, mountings, measured, simulated = _tables(logs)
    entries = {
        name: _entry(errors, predicted, mountings)
        for name, errors, predicted in zip(names, measured, simulated, strict=True)
    }
    scored = np.array([bool(np.isfinite(errors).all()) for errors in measured])
    missing = [f"{names[int(k)]} has no score: a run of it failed" for k in np.flatnonzero(~scored)]
    if not np.isfinite(simulated).all():
        missing.append("No gap and no rank agreement: the log has no whole dry run")
    if measured.shape[-1] < 2:
        missing.append("No interval as mounted: it needs two repeats at least")
    if len(mountings) < 2:
        missing.append("No interval mounted anew: it needs two lungs or sessions at least")
    both = scored & np.isfinite(simulated).all(axis=(1, 2))
    agrees: dict[str, Interval] = {}
    if both.sum() > 1:
        agrees = agreement(simulated[both].mean(axis=2), measured[both].mean(axis=(2, 3)))
    return Trial(entries, agrees, tuple(missing))


def _entry(errors: Floats, simulated: Floats, mountings: Sequence[str]) -> EntryTrial:
    """One entry: errors ``(M, P, K)``, NaN where a run failed; in simulation ``(M, P)``."""
    count, pips, repeats = errors.shape

    def by_mounting(values: Floats) -> dict[str, Interval]:
        each = np.stack(with_error(values), axis=1)
        return {name: interval(*x) for name, x in zip(mountings, each, strict=True)}

    gaps = errors - simulated[..., None]
    apart, error, _ = with_error(gaps)
    within = between = math.nan
    if repeats > 1:
        within = float(np.sqrt(errors.var(axis=-1, ddof=1).mean()))
        if count > 1:
            between = math.sqrt(max(apart.var(ddof=1) - (error**2).mean(), 0.0))
    done = np.isfinite(errors).sum(axis=(1, 2))
    share = stats.binomtest(int(done.sum()), errors.size).proportion_ci(method="exact")
    return EntryTrial(
        interval(*with_error(errors.reshape(-1, repeats))),
        by_mounting(errors),
        dict(zip(mountings, simulated.mean(axis=1).tolist(), strict=True)),
        interval(*with_error(apart[None])),
        by_mounting(gaps),
        Interval(float(done.sum()) / errors.size, float(share.low), float(share.high)),
        {name: (int(n), pips * repeats) for name, n in zip(mountings, done, strict=True)},
        within,
        between,
    )


def _tables(logs: Sequence[Path]) -> tuple[Sequence[str], list[str], Floats, Floats]:
    """Entries and mountings; errors on the bench ``(E, M, P, K)``, in simulation ``(E, M, P)``."""
    sessions = [read_session(log) for log in logs]
    first = sessions[0].plan
    mountings, hashes = list[str](), dict[str, str]()
    measured, simulated = [], []
    for number, session in enumerate(sessions, 1):
        log, plan = session.path, session.plan
        for key, of in (("entries", sorted), ("pips", tuple), ("repeats", int), ("track", str)):
            if of(getattr(plan, key)) != of(getattr(first, key)):
                raise InputError(f"{log} is of another trial than {logs[0]}: {key} differ")
        ended = {
            (x["entry"], x["lung"], x["pip"], x["repeat"]): x.get("error")
            for x in session.ended
            if x["kind"] == "scored"
        }
        predicted: dict[tuple[str, str, float], float] = {}
        for line in session.of_type("session"):
            for name, digest in line["entries"].items():
                if hashes.setdefault(name, digest) != digest:
                    raise InputError(f"{log}: the files of {name} changed; it is another entry")
            predicted |= {(e, lung, pip): x for e, lung, pip, x in line.get("simulated", ())}
        lungs = sorted(plan.lungs)
        cells = list(product(first.entries, lungs, plan.pips))
        shape = len(first.entries), len(lungs), len(plan.pips)
        if left := len(cells) * plan.repeats - len(ended):
            raise InputError(f"{log}: {left} scored runs are left; `run` continues the plan")
        repeats = range(1, plan.repeats + 1)
        errors = [[ended[*cell, repeat] for repeat in repeats] for cell in cells]
        measured.append(np.array(errors, float).reshape(*shape, -1))
        simulated.append(np.reshape([predicted.get(cell, math.nan) for cell in cells], shape))
        mountings += [x if len(logs) == 1 else f"{x} of session {number}" for x in lungs]
    tables = np.concatenate(measured, axis=1), np.concatenate(simulated, axis=1)
    return first.entries, mountings, *tables
