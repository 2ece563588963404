"""What the commands of a record give: a function of them, the simulators and the draws.

Nothing of it stands in a record. It is computed by :mod:`ventbench.board.replay`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.interval import Interval
from ventbench.entries.runs import Runs
from ventbench.task import draws, protocol
from ventbench.task.metrics import bootstrap
from ventbench.task.metrics.score import normalised


@dataclass(frozen=True, eq=False)
class Figures:
    """Figures of all runs of a record; L lungs, P PIPs, K draws, nominal runs first.

    Tables of runs have shape ``(1 + K, L, P)`` and are NaN where a controller failed.
    """

    error: Floats  #: mean |pressure - target|, cmH2O.
    controllable: Floats  #: the same without the first step of an inspiration, cmH2O.
    attainable: Floats  #: least error of any commands in the cell, cmH2O.
    pid: Floats  #: error of the lung's best PID in the cell, cmH2O.
    peak: Floats  #: highest pressure of the run, cmH2O; not NaN.
    steps_above: Ints  #: samples above the safety limit in a breath, the most of the run.
    safe: Bools  #: whether all runs of a lung pass the safety gate, ``(L,)``.
    #: disagreement of the ensemble along the nominal runs, cmH2O, ``(L, P)``; NaN where one failed.
    spread: Floats
    pressure: Floats  #: nominal inspirations of the last breath, cmH2O, ``(L, P, S)``.
    u_in: Floats  #: commands of the same, %, ``(L, P, S)``.
    first: Floats  #: first command of each nominal run, %, ``(L, P)``; NaN where it failed.
    rig: Ints  #: of each draw, ``(L, K)``.
    member: Ints  #: of the ensemble, ``(L, K)``.
    #: runs under missing physics; None without, or where their commands are not at hand.
    stressed: Runs | None

    @property
    def nominal(self) -> Floats:
        """Error of the nominal runs, cmH2O, ``(L, P)``."""
        return self.error[0]

    @property
    def drawn(self) -> Floats:
        """Error of the drawn runs, cmH2O, ``(K, L, P)``."""
        return self.error[1:]

    @property
    def ranked(self) -> Bools:
        """Whether each draw is on rigs that nobody trained on, ``(K,)``."""
        return draws.ranked(self.rig)

    @cached_property
    def normalised(self) -> Floats:
        """Normalised score of each run."""
        return normalised(self.controllable, self.attainable, self.pid)

    @property
    def ranked_values(self) -> Floats:
        """What ranks: mean normalised score of each lung and ranked draw, ``(L, k)``."""
        return self.normalised[1:][self.ranked].mean(axis=2).T

    def interval(self, values: Floats) -> Interval | None:
        """Mean of values of each lung and ranked draw, ``(L, k)``, with its 95 % interval.

        Resampled alike for all records of the same draws; None if a drawn run failed.
        """
        if not np.isfinite(self.drawn).all():
            return None
        rig, member = self.rig[:, self.ranked], self.member[:, self.ranked]
        resampled = bootstrap.resampled_scores(values, rig, member)
        return Interval(float(np.mean(values)), *bootstrap.limits(resampled))

    @property
    def training_values(self) -> Floats:
        """The same of the draws on rigs of the training, to compare."""
        return self.normalised[1:][~self.ranked].mean(axis=2).T

    @property
    def exploitation(self) -> float:
        """Exploitation index, cmH2O: mean of the ensemble's spread over all cells; or NaN."""
        return float(self.spread.mean())

    @property
    def leak(self) -> str:
        """Say where nominal first commands differ from lung to lung; empty if nowhere.

        The first observation of a nominal run is that of a lung at PEEP: start, target and step are
        common to all lungs. A controller that is not told the lung cannot answer differently; one
        that does has learned it, or nobody has computed its commands from observations. The reverse
        is no proof of honesty. Failed runs are left out.
        """
        failed = np.isnan(self.first)
        highest = np.max(np.where(failed, -np.inf, self.first), axis=0)
        lowest = np.min(np.where(failed, np.inf, self.first), axis=0)
        apart = np.flatnonzero(highest > lowest)
        if not len(apart):
            return ""
        at = apart[0]
        low, high, pip = f"{lowest[at]:g} %", f"{highest[at]:g} %", protocol.PIPS[at]
        return (
            f"in the nominal run at PIP {pip:g} the first command is {low} on "
            f"one lung and {high} on another, though the first observation is the "
            "same: the lung was known"
        )
