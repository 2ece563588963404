"""Figures of runs under every condition: error, safety and volume, and what follows from them.

A run is *survived* if the controller did not fail, passed the protocol's safety gate in every
breath, and held the plateau of the last breath (mean of its last 0.3 s) within
``2 cmH2O + 4 % of PIP`` of PIP. That is the tolerance that makers of ventilators declare for airway
pressure; the last breath, because a controller may take two breaths to notice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.base.interval import Interval
from ventbench.sandbox.child.cell import Failure
from ventbench.task import protocol
from ventbench.task.lungs import LUNG_IDS
from ventbench.task.metrics.bootstrap import limits, resampled_scores
from ventbench.task.stressors import (
    WEIGHTS,
    Condition,
    conditions,
    held_out,
    stressor,
)

if TYPE_CHECKING:
    import pandas as pd


#: Number of draws of an official score under stress: each lung has each PIP once.
DRAWS = 6

#: Place of the PIP of the first lung in each draw; the other lungs follow it.
_TURNS = (0, 3, 1, 4, 2, 5)

#: Tolerance of the plateau, cmH2O and share of PIP: "2 cmH2O + 4 % of the actual reading", as data
#: sheets of intensive-care ventilators declare for airway pressure.
PLATEAU_TOLERANCE, PLATEAU_SHARE = 2.0, 0.04


@dataclass(frozen=True)
class CellFailure:
    """A failure and its cell."""

    condition: str  #: id of the condition.
    lung: str  #: id; also where the submission did not know it.
    pip: float  #: nominal PIP, cmH2O.
    draw: int | None  #: counted from 1; None for the nominal cell.
    failure: Failure  #: what went wrong.
    message: str  #: the failure in one sentence for a person.

    def to_json(self) -> dict[str, Any]:
        """The cell and the failure as JSON values."""
        cell = {"condition": self.condition, "lung": self.lung, "pip": self.pip, "draw": self.draw}
        return {**cell, **self.failure.to_json(), "message": self.message}


@dataclass(frozen=True, eq=False, repr=False)
class Runs:
    """Figures of every run of an entry; S conditions, L lungs, n cells of each lung.

    The first condition is none: the same cells without a stressor.
    """

    conditions: tuple[Condition, ...]  #: length S.
    lungs: tuple[str, ...]  #: ids, length L.
    pips: Floats  #: nominal PIP, cmH2O, ``(L, n)``.
    rig: Ints  #: session of each lung in each cell, ``(L, n)``.
    member: Ints  #: member of the ensemble, ``(L, n)``.
    #: mean |airway pressure - PIP| over the scored inspirations, cmH2O, ``(S, L, n)``; NaN where
    #: the controller failed.
    error: Floats
    safe: Bools  #: whether a run passed the safety gate in all breaths, ``(S, L, n)``.
    survived: Bools  #: see the module, ``(S, L, n)``.
    alarm_s: Floats  #: time above PIP + 15 % in a breath, the longest of the run, s, ``(S, L, n)``.
    peak: Floats  #: highest pressure, cmH2O, ``(S, L, n)``.
    #: volume in the lung at the end of the scored inspirations, mean, mL, ``(S, L, n)``; NaN where
    #: the plants have no such signal.
    volume: Floats
    draw: Ints  #: of each cell, counted from 1; 0 without deviations, ``(n,)``.
    #: |mean of the last 0.3 s - PIP| of the last breath, cmH2O, ``(S, L, n)``.
    plateau_error: Floats
    #: all commands, %, ``(S, L, n, BREATHS, INSPIRATION_STEPS)``, 0 once a cell has failed; not in
    #: records.
    requested: Floats | None = None
    failures: Sequence[CellFailure] = ()  #: what failed; not in records.

    @property
    def score(self) -> float:
        """Weighted mean error of the stressed conditions, cmH2O; NaN if any cell failed."""
        return float(np.mean(self.by_lung_and_draw))

    def over_conditions(self, values: Floats) -> Floats:
        """Weighted mean over the stressed conditions of values ``(S, L, n)``, ``(L, n)``."""
        weights = [WEIGHTS.get(condition.id, 1.0) for condition in self.conditions[1:]]
        return np.average(values[1:], axis=0, weights=weights)

    @property
    def held_out_score(self) -> float:
        """Mean error under stressors that nothing may be tuned under, cmH2O; NaN without any."""
        excluded = held_out()
        at = [
            k for k, c in enumerate(self.conditions) if c.stressors and set(c.stressors) <= excluded
        ]
        return float(np.mean(self.error[at])) if at else float("nan")

    @property
    def unstressed(self) -> float:
        """Mean error of the same cells without a stressor, cmH2O."""
        return float(np.mean(self.error[0]))

    @property
    def survived_share(self) -> float:
        """Share of the stressed runs that were survived, 0..1."""
        return float(np.mean(self.survived[1:]))

    @property
    def rise(self) -> Floats:
        """Error less that of the same cell without a stressor, cmH2O, ``(S, L, n)``."""
        return self.error - self.error[:1]

    @property
    def volume_ratio(self) -> Floats:
        """Volume over that of the same cell without a stressor, ``(S, L, n)``."""
        return self.volume / self.volume[:1]

    @property
    def complete(self) -> bool:
        """Whether all conditions, lungs and draws of the track were run."""
        return (
            self.conditions == conditions()
            and self.lungs == LUNG_IDS
            and self.pips.shape[1] == DRAWS
            and np.array_equal(self.pips, np.array(protocol.PIPS)[pip_columns(*self.pips.shape)])
        )

    @property
    def by_lung_and_draw(self) -> Floats:
        """Weighted mean error of the stressed conditions, cmH2O, ``(L, n)``; NaN if one failed."""
        return self.over_conditions(self.error)

    def interval(self, values: Floats) -> Interval:
        """A mean over cells with its interval: draws, rigs and ensemble members resampled.

        Alike for all entries. PIPs are chosen, not drawn, and lungs and PIPs form a Latin square:
        what a PIP adds on average is taken out before, as what a lung adds is. Values ``(L, n)`` of
        any unit, such as a mean over conditions.
        """
        mean = float(np.mean(values))
        if values.shape[1] < 2 or not math.isfinite(mean):
            return Interval(mean)
        levels, index, count = np.unique(self.pips, return_inverse=True, return_counts=True)
        if count.min() > 1:
            index = index.reshape(values.shape)
            sums = np.bincount(index.ravel(), weights=values.ravel(), minlength=len(levels))
            values = values - (sums / count)[index] + mean
        return Interval(mean, *limits(resampled_scores(values, self.rig, self.member)))

    def difference(self, baseline: Runs) -> Interval:
        """Stress score less that of another entry, cmH2O, and its paired 95 % interval.

        Raises:
            InputError: if the other one was run on other draws or under other conditions.
        """
        names = ("conditions", "lungs", "pips", "rig", "member")
        if not all(np.array_equal(getattr(self, x), getattr(baseline, x)) for x in names):
            raise InputError("these entries were run under different conditions or draws")
        return self.interval(self.by_lung_and_draw - baseline.by_lung_and_draw)

    def to_frame(self) -> pd.DataFrame:
        """One row a run.

        Returns:
            Columns ``condition`` (id), ``lung`` (id), ``pip_cmH2O``, ``draw`` (0 without
            deviations, then 1..K), ``rig``, ``member``, ``error_cmH2O`` (mean |pressure - target|;
            NaN where the controller failed), ``rise_cmH2O``, ``plateau_error_cmH2O``, ``survived``,
            ``safe``, ``above_alarm_s``, ``peak_cmH2O``, ``volume_mL`` and ``volume_ratio``.
        """
        import pandas as pd

        s, lung, cell = (axis.ravel() for axis in np.indices(self.error.shape))
        return pd.DataFrame(
            {
                "condition": np.array([c.id for c in self.conditions])[s],
                "lung": np.array(self.lungs)[lung],
                "pip_cmH2O": self.pips[lung, cell],
                "draw": self.draw[cell],
                "rig": self.rig[lung, cell],
                "member": self.member[lung, cell],
                "error_cmH2O": self.error.ravel(),
                "rise_cmH2O": self.rise.ravel(),
                "plateau_error_cmH2O": self.plateau_error.ravel(),
                "survived": self.survived.ravel(),
                "safe": self.safe.ravel(),
                "above_alarm_s": self.alarm_s.ravel(),
                "peak_cmH2O": self.peak.ravel(),
                "volume_mL": self.volume.ravel(),
                "volume_ratio": self.volume_ratio.ravel(),
            }
        )

    def summary(self) -> pd.DataFrame:
        """One row a condition, by its id: means over cells, and the worst run."""
        import pandas as pd

        return pd.DataFrame(list(self.by_condition)).set_index("condition")

    def headline(self) -> dict[str, Any]:
        """What a table shows of an entry, as JSON values: score, rise, survival, safety, worst."""
        worst = max(self.by_condition[1:], key=lambda row: order(row["error_cmH2O"]))
        rise = self.interval(self.over_conditions(self.rise))
        return {
            "score": number(self.score),
            "ci95": _ci95(self.interval(self.by_lung_and_draw)),
            "unstressed": number(self.unstressed),
            "rise": number(rise.value),
            "rise_ci95": _ci95(rise),
            "held_out_score": number(self.held_out_score),
            "survived": self.survived_share,
            "survived_ci95": _ci95(self.interval(self.survived[1:].mean(axis=0))),
            "survived_unstressed": float(np.mean(self.survived[0])),
            "unsafe_runs": int(np.sum(~self.safe[1:])),
            "stressed_runs": int(self.safe[1:].size),
            "above_alarm_s": number(np.mean(self.alarm_s[1:])),
            "worst_condition": worst["condition"],
            "worst_error": worst["error_cmH2O"],
            "complete": self.complete,
            "conditions": list(self.by_condition),
        }

    @cached_property
    def by_condition(self) -> tuple[dict[str, Any], ...]:
        """Means and the worst run of each condition, as JSON values; not to be changed."""
        return tuple(self._of_condition(k) for k in range(len(self.conditions)))

    def _of_condition(self, k: int) -> dict[str, Any]:
        condition, error = self.conditions[k], self.error[k]
        lung, draw = np.unravel_index(np.argmax(np.nan_to_num(error, nan=np.inf)), error.shape)
        return {
            "condition": condition.id,
            "stressors": list(condition.stressors),
            "severity": condition.severity,
            "category": category_of(condition),
            "error_cmH2O": number(np.mean(error)),
            "ci95": _ci95(self.interval(error)),
            "rise_cmH2O": number(np.mean(self.rise[k])),
            "rise_ci95": _ci95(self.interval(self.rise[k])),
            "survived": float(np.mean(self.survived[k])),
            "unsafe_runs": int(np.sum(~self.safe[k])),
            "above_alarm_s": number(np.mean(self.alarm_s[k])),
            "peak_cmH2O": number(np.max(self.peak[k])),
            "volume_ratio": number(np.median(self.volume_ratio[k])),
            "worst": {
                "lung": self.lungs[lung],
                "pip": float(self.pips[lung, draw]),
                "error_cmH2O": number(error[lung, draw]),
            },
        }


def pip_columns(lungs: int, n: int) -> Ints:
    """Place of the PIP of each lung and draw among the protocol's, ``(lungs, n)``.

    In each draw the lungs have different PIPs, and over six draws each lung has each PIP once.
    """
    offsets = np.array(_TURNS)[np.arange(n) % len(_TURNS)]
    return (np.arange(lungs)[:, None] + offsets) % len(protocol.PIPS)


def category_of(condition: Condition) -> str:
    """Category of a condition: of its stressor, ``"pairs"`` or ``"none"``."""
    categories = [stressor(name).category for name in condition.stressors]
    return "pairs" if len(categories) > 1 else "".join(categories) or "none"


def number(value: float | np.floating) -> float | None:
    """A JSON number; None where it does not exist."""
    return float(value) if math.isfinite(value) else None


def _ci95(estimate: Interval) -> list[float | None]:
    return [number(estimate.low), number(estimate.high)]


def order(value: float | None) -> float:
    """What a JSON number is sorted by: what does not exist is the most."""
    return math.inf if value is None else value
