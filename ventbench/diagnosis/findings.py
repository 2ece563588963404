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
Stage = Literal["before", "refit", "after", "rigs"]


#: What may have an order in time: the valve's gain, the zero of the pressure, the errors' size.
Quantity = Literal["gain", "zero", "error"]


@dataclass(frozen=True)
class MissingMechanism:
    """A mechanism that the recording needs and the simulator lacks.

    Attributes:
        name: name in the library.
        parameters: estimates by short name.
        confidence: how far the name is preferred over other names, 0..1: its posterior probability
            if one of the compared mechanisms acts. It says nothing of effects that none of them is.
        alternatives: mechanisms that the recording cannot distinguish from it, the likeliest first.
        nats: held-out log-likelihood that is lost without it.
        changed: True if the simulator has the mechanism too, with other parameters.
        simulator_values: parameters that the simulator has, by short name; empty if not changed.
        worth: root-mean-square error, cmH2O, by which held-out breaths are fitted worse without it;
            NaN if unknown.
        breaths: of a change at a breath, the id of the first breath after it, and the ids between
            which that lies with 95 %; else None.
        affected: ids of the breaths in which it acts, if it acts in some only.
        explains: share of the squared error that is shown to be no noise which it explains, 0..1.
    """

    name: str
    parameters: dict[str, Estimate]
    confidence: float
    alternatives: tuple[str, ...]
    nats: float
    changed: bool = False
    simulator_values: dict[str, float] = field(default_factory=dict)
    worth: float = float("nan")
    breaths: tuple[int, int, int] | None = None
    affected: tuple[int, ...] = ()
    explains: float = 1.0


@dataclass(frozen=True, eq=False)
class NonparametricTerm:
    """A place in the model where an effect acts that the library does not have.

    Attributes:
        name: name of the place, such as ``f(V)``.
        meaning: what the place means, in words.
        explains: share of the squared error above the noise that the term explains, 0..1.
        nats: held-out log-likelihood that it gains.
        x: what the term depends on, ``(k,)``.
        x_unit: name and unit of ``x``, such as ``volume, mL``.
        y: value of the term, without the part that R and C can absorb, ``(k,)``.
        y_unit: name and unit of ``y``.
        form_of: missing mechanisms that the term contains. If there are any, the term is no further
            effect: it shows how their form differs from the library's.
        places: where the effect may act and the weight of each place that was compared, the largest
            first: of a course in time by held-out breaths, of a curve by BIC.
    """

    name: str
    meaning: str
    explains: float
    nats: float
    x: Floats
    x_unit: str
    y: Floats
    y_unit: str
    form_of: tuple[str, ...] = ()
    places: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class ErrorRegion:
    """A range of one quantity in which the refitted simulator errs.

    Attributes:
        axis: the quantity, such as ``time since inspiration``.
        low: start of the range.
        high: end of the range.
        unit: unit of the range.
        mean_error: recorded minus simulated pressure, cmH2O: mean over breaths of each breath's
            mean over the range, as charts show it.
        p_value: corrected for all ranges of all axes.
        share: share of the squared error above the noise that lies in the range, 0..1.
    """

    axis: str
    low: float
    high: float
    unit: str
    mean_error: float
    p_value: float
    share: float


@dataclass(frozen=True)
class Change:
    """Something that has an order in time though breaths should be exchangeable.

    Attributes:
        of: ``gain`` of the valve, ``zero`` of the pressure, or size of the ``error``.
        breath: id of the first breath after the change.
        size: factor from before to after (gain, error), or shift (zero), cmH2O.
        drifts: whether a straight line from the first to the last breath fits better than a step;
            the size is then that of the whole line.
        p_value: by permutations of the breaths.
        worth: root-mean-square error that it causes, cmH2O.
    """

    of: Quantity
    breath: int
    size: float
    drifts: bool
    p_value: float
    worth: float


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

    Attributes:
        held_out_breaths: ids of the held-out breaths, which no fit and no test has seen.
        before: error of the simulator as given.
        refit: error after R, C, R_ex and PEEP are refitted.
        after: error of the corrected simulator.
        noise_floor: root-mean-square error of a perfect simulator, cmH2O.
        groups: errors of parts of the breath and of lungs, by group and stage, such as
            ``{"lung R5C10": {"before": OpenLoopError(...), ...}}``.
        gain_error: root-mean-square error, cmH2O, that a breath to come has because the valve's
            gain differs from breath to breath; 0 if it does not.
        usual: root-mean-square error of the corrected simulator, cmH2O, without the tenth of the
            breaths that err most; NaN if unknown.
        sensor_noise: standard deviation of quiet readings, cmH2O, which no missing physics can
            raise; NaN if nothing is quiet.
    """

    held_out_breaths: tuple[int, ...]
    before: OpenLoopError
    refit: OpenLoopError
    after: OpenLoopError
    noise_floor: float
    groups: dict[str, dict[str, OpenLoopError]]
    gain_error: float = 0.0
    usual: float = float("nan")
    sensor_noise: float = float("nan")

    @property
    def least_error(self) -> float:
        """Root-mean-square error of a simulator that lacks nothing, cmH2O."""
        return float(np.hypot(self.noise_floor, self.gain_error))

    @property
    def unexplained(self) -> float:
        """Usual error of the corrected simulator beyond the noise and the gain's scatter, cmH2O."""
        usual = self.usual if np.isfinite(self.usual) else self.after.rmse
        beyond = usual**2 - self.least_error**2
        return float(np.sqrt(max(beyond, 0.0))) if np.isfinite(beyond) else float("nan")


@dataclass(frozen=True, eq=False)
class Traces:
    """Recorded breaths with simulated pressures; arrays ``(n, T)``, NaN where unknown.

    Attributes:
        breaths: n recorded breaths.
        held_out: which of them no fit and no test of a term has seen, bool ``(n,)``.
        before: pressure of the simulator as given, cmH2O.
        refit: pressure with R, C, R_ex and PEEP refitted, cmH2O.
        after: pressure of the corrected simulator, cmH2O.
        flow: flow of the refitted simulator into the lung, mL/s, or None.
        volume: volume of the refitted simulator, mL, or None.
    """

    breaths: Breaths
    held_out: Bools
    before: Floats
    refit: Floats
    after: Floats
    flow: Floats | None = None
    volume: Floats | None = None


@dataclass(frozen=True, eq=False)
class BreathRequest:
    """Breaths to record next, because they distinguish between hypotheses.

    Attributes:
        title: what to do on the rig, in words.
        why: mechanisms that the breaths distinguish.
        nats: log-likelihood ratio that the breaths are expected to give.
        u_in: commands of the inspiratory valve, %, ``(k, T)``.
        u_out: commands of the expiratory valve, 0/1, ``(k, T)``.
        dt: time to the next sample, s, ``(k, T)``.
    """

    title: str
    why: tuple[str, ...]
    nats: float
    u_in: Floats
    u_out: Floats
    dt: Floats

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


@dataclass(frozen=True)
class RigParameters:
    """Parameters of one rig of the recording.

    Attributes:
        lung: label of its lung.
        rig: number of the rig.
        breaths: ids of its breaths that were fitted.
        parameters: by path, such as ``R`` or ``sensor_lag.tau``.
    """

    lung: str
    rig: int
    breaths: tuple[int, ...]
    parameters: dict[str, float]


@dataclass(frozen=True, eq=False)
class Findings:
    """Everything that a diagnosis establishes.

    Attributes:
        verdict: see :data:`Verdict`.
        mechanisms: missing ones, the most important first.
        nonparametric: a term for an effect that is not in the library, or None.
        form: a term for what the form of a missing mechanism lacks, or None; see
            :attr:`NonparametricTerm.form_of`.
        location: regions in which the refitted simulator errs, the most certain first.
        open_loop: errors before and after the correction.
        lungs: one for each lung of the recording.
        request: breaths to record next, or None if nothing is open.
        traces: pressures of all breaths.
        plants: the corrected simulator of each lung, by label.
        simulator: name of what was diagnosed, such as ``physics``.
        noise: standard deviation of the measurement noise, cmH2O, and its correlation between
            neighbouring samples.
        notes: further information for the reader, a sentence each.
        seconds: computing time.
        settings: every threshold of the diagnosis.
        remaining: regions in which the corrected simulator still errs, the most certain first.
        split: ids of the breaths by use: ``training``, ``testing`` and ``judging``; few breaths of
            a lung have both of the last two uses.
        chosen: what the corrected simulator of each lung is, by label: the simulator as given,
            refitted, corrected, or corrected with strengths of each rig, whichever errs least on
            the judging breaths.
        gain_scatter: standard deviation of the logarithm of the breaths' valve gains; 0 if all
            breaths have the same gain.
        detection_limits: if nothing is missing: smallest strength of each mechanism that would have
            been seen, in the unit of the strength, by name; infinite if none would.
        rigs: parameters of each rig where the correction has them; empty otherwise.
        changes: what changes in the course of the recording and is in no model.
        saturated: reading at which the pressure sensor saturates, cmH2O, and share of the readings
            that do, which are left out; None if it does not.
    """

    verdict: Verdict
    mechanisms: tuple[MissingMechanism, ...]
    nonparametric: NonparametricTerm | None
    location: tuple[ErrorRegion, ...]
    open_loop: OpenLoopComparison
    lungs: tuple[LungMatch, ...]
    request: BreathRequest | None
    traces: Traces
    plants: dict[str, Plant]
    simulator: str
    noise: tuple[float, float]
    notes: tuple[str, ...]
    seconds: float
    settings: SelectionConfig = DEFAULT
    form: NonparametricTerm | None = None
    remaining: tuple[ErrorRegion, ...] = ()
    split: dict[str, tuple[int, ...]] = field(default_factory=dict)
    chosen: dict[str, Stage] = field(default_factory=dict)
    gain_scatter: float = 0.0
    detection_limits: dict[str, float] = field(default_factory=dict)
    rigs: tuple[RigParameters, ...] = ()
    changes: tuple[Change, ...] = ()
    saturated: tuple[float, float] | None = None
