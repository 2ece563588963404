"""The parts of a diagnosis: verdict, mechanisms, error regions, open-loop errors, traces."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ventbench.base.arrays import Bools, Floats
from ventbench.diagnosis.settings import DEFAULT, SelectionConfig
from ventbench.mechanics.labels import Estimate, LungMatch
from ventbench.recordings.breaths import Breaths
from ventbench.task.interfaces import Plant

#: ``named``: mechanisms of the library are missing. ``nothing_missing``: none is. ``unnamed``:
#: something is missing that the library does not have; a nonparametric term may say where it acts.
Verdict = Literal["named", "nothing_missing", "unnamed"]

#: A simulator as given, with R, C, R_ex and PEEP refitted, and corrected.
Stage = Literal["before", "refit", "after"]


#: Name of the group of all samples but the first of each breath.
FULL_BREATH = "whole breath"

#: What may have an order in time: the valve's gain, the zero of the pressure, the errors' size.
Quantity = Literal["gain", "zero", "error"]


@dataclass(frozen=True)
class MissingMechanism:
    """A mechanism that the recording needs and the simulator lacks."""

    name: str  #: name in the library.
    parameters: dict[str, Estimate]  #: estimates by short name.
    #: posterior probability that it acts, 0..1, over all sets of names, of unknowns at places and,
    #: of what differs from breath to breath, of an error that nobody can place.
    confidence: float
    #: mechanisms that the recording cannot distinguish from it, the likeliest first.
    alternatives: tuple[str, ...]
    nats: float  #: held-out log-likelihood that is lost without it.
    changed: bool = False  #: True if the simulator has the mechanism too, with other parameters.
    #: parameters that the simulator has, by short name; empty if not changed.
    simulator_values: dict[str, float] = field(default_factory=dict)
    #: root-mean-square error, cmH2O, by which held-out breaths are fitted worse without it; NaN if
    #: unknown.
    worth: float = float("nan")
    #: of a change at a breath, the id of the first breath after it, and the ids between which that
    #: lies with 95 %; else None.
    breaths: tuple[int, int, int] | None = None
    affected: tuple[int, ...] = ()  #: ids of the breaths in which it acts, if it acts in some only.
    #: share of the squared error that is shown to be no noise which it explains, 0..1.
    explains: float = 1.0


@dataclass(frozen=True, eq=False)
class NonparametricTerm:
    """A place in the model where an effect acts that the library does not have."""

    name: str  #: name of the place, such as ``f(V)``.
    meaning: str  #: what the place means, in words.
    explains: float  #: share of the squared error above the noise that the term explains, 0..1.
    nats: float  #: held-out log-likelihood that it gains.
    x: Floats  #: what the term depends on, ``(k,)``.
    x_unit: str  #: name and unit of ``x``, such as ``volume, mL``.
    y: Floats  #: value of the term, without the part that R and C can absorb, ``(k,)``.
    y_unit: str  #: name and unit of ``y``.
    #: missing mechanisms that the term contains. If there are any, the term is no further effect:
    #: it shows how their form differs from the library's.
    form_of: tuple[str, ...] = ()
    #: where the effect may act and the weight of each place that was compared, the largest first:
    #: of a course in time by held-out breaths, of a curve by BIC.
    places: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class ErrorRegion:
    """A range of one quantity in which the refitted simulator errs."""

    axis: str  #: the quantity, such as ``time since inspiration``.
    low: float  #: start of the range.
    high: float  #: end of the range.
    unit: str  #: unit of the range.
    #: recorded minus simulated pressure, cmH2O: mean over breaths of each breath's mean over the
    #: range, as charts show it.
    mean_error: float
    p_value: float  #: corrected for all ranges of all axes.
    share: float  #: share of the squared error above the noise that lies in the range, 0..1.


@dataclass(frozen=True)
class Change:
    """Something that has an order in time though breaths should be exchangeable."""

    of: Quantity  #: ``gain`` of the valve, ``zero`` of the pressure, or size of the ``error``.
    breath: int  #: id of the first breath after the change.
    size: float  #: factor from before to after (gain, error), or shift (zero), cmH2O.
    #: whether a straight line from the first to the last breath fits better than a step; the size
    #: is then that of the whole line.
    drifts: bool
    p_value: float  #: by permutations of the breaths.
    worth: float  #: root-mean-square error that it causes, cmH2O.


@dataclass(frozen=True)
class OpenLoopError:
    """Mean absolute and root-mean-square open-loop error, cmH2O."""

    mae: float
    rmse: float


@dataclass(frozen=True, eq=False)
class OpenLoopComparison:
    """Open-loop errors of held-out breaths: of inspirations, and in ``groups`` of expirations too.

    On each lung, ``after`` is at most ``refit``, and ``refit`` at most ``before``: these breaths
    choose the corrected simulator.
    """

    #: ids of the held-out breaths, which no fit and no test has seen.
    held_out_breaths: tuple[int, ...]
    before: OpenLoopError  #: error of the simulator as given.
    refit: OpenLoopError  #: error after R, C, R_ex and PEEP are refitted.
    after: OpenLoopError  #: error of the corrected simulator.
    #: root-mean-square error of a perfect simulator over whole breaths, cmH2O: the noise of the
    #: readings, the first of which it starts from.
    noise_floor: float
    #: errors of parts of the breath and of lungs, by group and stage, such as ``{"lung R5C10":
    #: {"before": OpenLoopError(...), ...}}``.
    groups: dict[str, dict[str, OpenLoopError]]
    #: root-mean-square error, cmH2O, that a breath to come has because the valve's gain or an
    #: effort differs from breath to breath; 0 if nothing does.
    scatter_error: float = 0.0

    @property
    def least_error(self) -> float:
        """Root-mean-square error of a simulator that lacks nothing, cmH2O."""
        return float(np.hypot(self.noise_floor, self.scatter_error))

    @property
    def whole(self) -> OpenLoopError:
        """Error of the corrected simulator over whole breaths."""
        return self.groups.get(FULL_BREATH, {}).get("after", self.after)

    @property
    def unexplained(self) -> float:
        """Error of the corrected simulator over whole breaths, beyond noise and scatter, cmH2O."""
        beyond = self.whole.rmse**2 - self.least_error**2
        return float(np.sqrt(max(beyond, 0.0))) if np.isfinite(beyond) else float("nan")


@dataclass(frozen=True, eq=False)
class Traces:
    """Recorded breaths with simulated pressures; arrays ``(n, T)``, NaN where unknown."""

    breaths: Breaths  #: n recorded breaths.
    held_out: Bools  #: which of them no fit and no test of a term has seen, bool ``(n,)``.
    before: Floats  #: pressure of the simulator as given, cmH2O.
    refit: Floats  #: pressure with R, C, R_ex and PEEP refitted, cmH2O.
    after: Floats  #: pressure of the corrected simulator, cmH2O.
    flow: Floats  #: flow of the refitted simulator into the lung, mL/s.
    volume: Floats  #: volume of the refitted simulator, mL.


@dataclass(frozen=True, eq=False)
class BreathRequest:
    """Breaths to record next, because they distinguish between hypotheses."""

    title: str  #: what to do on the rig, in words.
    why: tuple[str, ...]  #: mechanisms that the breaths distinguish.
    nats: float  #: log-likelihood ratio that the breaths are expected to give.
    u_in: Floats  #: commands of the inspiratory valve, %, ``(k, T)``.
    u_out: Floats  #: commands of the expiratory valve, 0/1, ``(k, T)``.
    dt: Floats  #: time to the next sample, s, ``(k, T)``.

    def to_csv(self) -> str:
        """Commands as a CSV file: ``breath_id,time_step,u_in,u_out``, breaths end to end.

        An operator plays it from the first row to the last; ``ventbench simulate --controls`` and
        :func:`ventbench.simulate` take it as it is. Times are s, ``u_in`` is in %.
        """
        time = np.concatenate([[0.0], np.cumsum(self.dt.ravel())[:-1]])
        number = np.repeat(np.arange(1, len(self.u_in) + 1), self.u_in.shape[1])
        columns = zip(number, time, self.u_in.ravel(), self.u_out.ravel(), strict=True)
        rows = [f"{k},{t:.6f},{u:.4f},{int(o)}" for k, t, u, o in columns]
        return "\n".join(["breath_id,time_step,u_in,u_out", *rows]) + "\n"


@dataclass(frozen=True, eq=False)
class Findings:
    """Everything that a diagnosis establishes."""

    verdict: Verdict  #: see :data:`Verdict`.
    mechanisms: tuple[MissingMechanism, ...]  #: missing ones, the most important first.
    #: a term for an effect that is not in the library, or None.
    nonparametric: NonparametricTerm | None
    #: regions in which the refitted simulator errs, the most certain first.
    location: tuple[ErrorRegion, ...]
    open_loop: OpenLoopComparison  #: errors before and after the correction.
    lungs: tuple[LungMatch, ...]  #: one for each lung of the recording.
    request: BreathRequest | None  #: breaths to record next, or None if nothing is open.
    traces: Traces  #: pressures of all breaths.
    #: the corrected simulator of each lung, by label, as the rig is at the end of the recording.
    plants: dict[str, Plant]
    simulator: str  #: name of what was diagnosed, such as ``physics``.
    #: standard deviation of the measurement noise, cmH2O, and its correlation between neighbouring
    #: samples.
    noise: tuple[float, float]
    notes: tuple[str, ...]  #: further information for the reader, a sentence each.
    seconds: float  #: computing time.
    settings: SelectionConfig = DEFAULT  #: every threshold of the diagnosis.
    #: a term for what the form of a missing mechanism lacks, or None; see
    #: :attr:`NonparametricTerm.form_of`.
    form: NonparametricTerm | None = None
    #: regions in which the corrected simulator still errs, the most certain first.
    remaining: tuple[ErrorRegion, ...] = ()
    #: ids of the breaths by use: ``training``, ``testing`` and ``judging``; few breaths of a lung
    #: have both of the last two uses.
    split: dict[str, tuple[int, ...]] = field(default_factory=dict)
    #: what the corrected simulator of each lung is, by label: the simulator as given, refitted or
    #: corrected, whichever errs least on the judging breaths.
    chosen: dict[str, Stage] = field(default_factory=dict)
    #: standard deviation of the logarithm of the breaths' valve gains; 0 if all breaths have the
    #: same gain.
    gain_scatter: float = 0.0
    #: if nothing is missing: smallest strength of each mechanism that would have been seen, in the
    #: unit of the strength, by name; infinite if none would.
    detection_limits: dict[str, float] = field(default_factory=dict)
    #: what changes in the course of the recording and is in no model.
    changes: tuple[Change, ...] = ()
    #: reading at which the pressure sensor saturates, cmH2O, and share of the readings that do,
    #: which are left out; None if it does not.
    saturated: tuple[float, float] | None = None
    #: that a share of the readings are none and are left out, where it is notable; else None.
    left_out: str | None = None
    #: the likeliest sets of terms by the search alone, with their probabilities: mechanisms, basis
    #: terms (something unknown at their place) and effects in time. Held-out breaths have no say.
    posterior: tuple[tuple[tuple[str, ...], float], ...] = ()
