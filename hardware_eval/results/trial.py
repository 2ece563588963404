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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from hardware_eval.bench.identity import interval
from hardware_eval.bench.plan import complete_runs
from hardware_eval.bench.raw_log import read_session
from ventbench.base import files
from ventbench.base.arrays import Floats
from ventbench.base.errors import InputError
from ventbench.base.interval import Interval

#: Draws of the interval of rank agreement, and their seed.
DRAWS, SEED = 1000, 0


def as_mounted(errors: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean over cells of repeats, its standard error and degrees of freedom, ``(...)`` each.

    Errors have shape ``(..., cells, repeats)``, two repeats at least. Where none differs it is 0.
    """
    *_, cells, repeats = errors.shape
    variance = errors.var(axis=-1, ddof=1) / repeats / cells**2
    total = variance.sum(axis=-1)
    freedom = total**2 / np.maximum((variance**2).sum(axis=-1) / (repeats - 1), 1e-300)
    return errors.mean(axis=(-1, -2)), np.sqrt(total), np.maximum(freedom, 1.0)


def mounted_anew(by_mounting: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean over two mountings or more, the last axis, its standard error and degrees of freedom."""
    count = by_mounting.shape[-1]
    error = by_mounting.std(axis=-1, ddof=1) / math.sqrt(count)
    return by_mounting.mean(axis=-1), error, np.full(error.shape, count - 1.0)


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


@dataclass(frozen=True)
class Trial:
    """What the sessions of a trial say."""

    entries: dict[str, EntryTrial]  #: by name.
    #: rank agreement of the entries with a score; empty for fewer than two.
    agreement: dict[str, Interval]
    missing: tuple[str, ...]  #: why something could not be said.

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return files.json_values(asdict(self))

    def __str__(self) -> str:
        rows = []
        for name, x in self.entries.items():
            done, runs = (sum(part) for part in zip(*x.successes.values(), strict=True))
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
    measured, simulated, mountings = _tables(logs)
    entries: dict[str, EntryTrial] = {}
    missing: list[str] = []
    for name, errors in measured.items():
        entries[name] = _entry(errors, simulated[name], mountings)
        if not np.isfinite(errors).all():
            missing.append(f"{name} has no score: a run of it failed")
    some = next(iter(measured.values()))
    if not all(np.isfinite(table).all() for table in simulated.values()):
        missing.append("No gap and no rank agreement: the log has no whole dry run")
    if some.shape[-1] < 2:
        missing.append("No interval as mounted: it needs two repeats at least")
    if len(mountings) < 2:
        missing.append("No interval mounted anew: it needs two lungs or sessions at least")
    both = [
        name
        for name in measured
        if np.isfinite(measured[name]).all() and np.isfinite(simulated[name]).all()
    ]
    agrees: dict[str, Interval] = {}
    if len(both) > 1:
        agrees = agreement(
            np.stack([simulated[name].mean(axis=1) for name in both]),
            np.stack([measured[name].mean(axis=(1, 2)) for name in both]),
        )
    return Trial(entries, agrees, tuple(missing))


def _entry(errors: Floats, simulated: Floats, mountings: Sequence[str]) -> EntryTrial:
    """One entry: errors ``(M, P, K)``, NaN where a run failed; in simulation ``(M, P)``."""
    repeats = errors.shape[-1]
    by_mounting = errors.mean(axis=(1, 2)) - simulated.mean(axis=1)
    predicted = dict(zip(mountings, simulated.mean(axis=1).tolist(), strict=True))
    means = errors.mean(axis=(1, 2)).tolist()
    scores = {name: Interval(mean) for name, mean in zip(mountings, means, strict=True)}
    gaps = {name: Interval(float(gap)) for name, gap in zip(mountings, by_mounting, strict=True)}
    score, gap = Interval(float(errors.mean())), Interval(float(by_mounting.mean()))
    within = between = math.nan
    if repeats > 1:
        flat = errors.reshape(1, -1, repeats)
        score = interval(*(x[0] for x in as_mounted(flat)))
        mean, error, freedom = as_mounted(errors - simulated[..., None])
        gaps = {name: interval(mean[k], error[k], freedom[k]) for k, name in enumerate(mountings)}
        own = np.stack(as_mounted(errors), axis=1)
        scores = {name: interval(*x) for name, x in zip(mountings, own, strict=True)}
        within = float(np.sqrt(errors.var(axis=-1, ddof=1).mean()))
        if len(mountings) > 1:
            excess = by_mounting.var(ddof=1) - (error**2).mean()
            between = float(np.sqrt(np.maximum(excess, 0.0)))
    if len(mountings) > 1:
        gap = interval(*mounted_anew(by_mounting))
    done = np.isfinite(errors).sum(axis=(1, 2))
    share = stats.binomtest(int(done.sum()), errors.size).proportion_ci(method="exact")
    success = Interval(float(done.sum()) / errors.size, float(share.low), float(share.high))
    each = errors[0].size
    return EntryTrial(
        score,
        scores,
        predicted,
        gap,
        gaps,
        success,
        {name: (int(n), each) for name, n in zip(mountings, done, strict=True)},
        within,
        between,
    )


def _tables(logs: Sequence[Path]) -> tuple[dict[str, Floats], dict[str, Floats], list[str]]:
    """Errors on the bench ``(M, P, K)`` and in simulation ``(M, P)`` by entry; the mountings."""
    plans = []
    measured: dict[str, list[Floats]] = {}
    simulated: dict[str, list[Floats]] = {}
    mountings: list[str] = []
    hashes: dict[str, str] = {}
    for number, log in enumerate(logs, 1):
        session = read_session(log)
        log, plan = session.path, session.plan
        plans.append((sorted(plan.entries), plan.pips, plan.repeats, plan.track))
        if plans[-1] != plans[0]:
            raise InputError(
                f"{log} is of another trial than {logs[0]}: entries, PIPs, repeats or track differ"
            )
        complete = complete_runs(session.logged)
        ended = {
            (x["entry"], x["lung"], x["pip"], x["repeat"]): x.get("error")
            for x in session.of_type("run")
            if x["kind"] == "scored"
            and (x["status"] == "failed" or (x["run"], x["attempt"]) in complete)
        }
        predicted: dict[tuple[str, str, float], float] = {}
        for line in session.of_type("session"):
            for name, digest in line["entries"].items():
                if hashes.setdefault(name, digest) != digest:
                    raise InputError(f"{log}: the files of {name} changed; it is another entry")
            predicted |= {(e, lung, pip): x for e, lung, pip, x in line.get("simulated", ())}
        left = len(plan.entries) * len(plan.lungs) * len(plan.pips) * plan.repeats - len(ended)
        if left:
            raise InputError(f"{log}: {left} scored runs are left; `run` continues the plan")
        for lung in sorted(plan.lungs):
            mountings.append(lung if len(logs) == 1 else f"{lung} of session {number}")
            for name in plan.entries:
                cells = [
                    [ended[name, lung, pip, k] for k in range(1, plan.repeats + 1)]
                    for pip in plan.pips
                ]
                measured.setdefault(name, []).append(np.array(cells, float))
                guess = [predicted.get((name, lung, pip), math.nan) for pip in plan.pips]
                simulated.setdefault(name, []).append(np.array(guess, float))
    return (
        {name: np.stack(tables) for name, tables in measured.items()},
        {name: np.stack(tables) for name, tables in simulated.items()},
        mountings,
    )
