"""What a diagnosis says: verdict, names with parameters, places, distances, the corrected plant."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ventbench.interfaces import Plant
from ventbench.recordings.breaths import Breaths

Floats = NDArray[np.float64]

#: ``named``: mechanisms of the library are missing; ``nothing_missing``: none is; ``unnamed``:
#: something is missing that the library does not have, and ``slot`` says where it sits.
Verdict = Literal["named", "nothing_missing", "unnamed"]


@dataclass(frozen=True)
class Estimate:
    """A parameter with the ends of its 95 % interval, in ``unit``."""

    value: float
    unit: str
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Named:
    """A mechanism that the recording needs and the simulator lacks.

    Attributes:
        name: of the library.
        parameters: by short name.
        confidence: 0..1, that this name is right and not one of the alternatives.
        alternatives: names that the recording cannot tell from it, the likeliest first.
        nats: held-out log-likelihood that is lost without it.
        changed: True if the simulator has it too, with other parameters.
        had: those that it has, by short name; empty if it is not changed.
    """

    name: str
    parameters: dict[str, Estimate]
    confidence: float
    alternatives: tuple[str, ...]
    nats: float
    changed: bool = False
    had: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Slot:
    """A place in the physics where something acts that has no name.

    Attributes:
        name: of the place, such as ``f(V)``.
        meaning: in words.
        explains: share of the excess squared error (above the noise) that it explains, 0..1.
        nats: held-out log-likelihood that it gains.
        x: what it depends on, ``(k,)``.
        x_unit: with its name, such as ``volume, mL``.
        y: its shape, what R and C could absorb removed, ``(k,)``.
        y_unit: likewise.
    """

    name: str
    meaning: str
    explains: float
    nats: float
    x: Floats
    x_unit: str
    y: Floats
    y_unit: str


@dataclass(frozen=True)
class Place:
    """Where the refitted simulator errs.

    Attributes:
        axis: such as ``"time since inspiration"``.
        low: start of the range.
        high: its end.
        unit: of the range.
        mean_error: recorded minus simulated, mean over the range, cmH2O.
        p_value: corrected for all ranges of all axes that were looked at.
        share: of the excess squared error that lies here, 0..1.
    """

    axis: str
    low: float
    high: float
    unit: str
    mean_error: float
    p_value: float
    share: float


@dataclass(frozen=True)
class Distance:
    """Open-loop error over the inspiratory samples of held-out breaths, cmH2O."""

    mae: float
    rmse: float


@dataclass(frozen=True, eq=False)
class Distances:
    """Open-loop distances on breaths that no fit has seen.

    Attributes:
        held_out_breaths: their ids.
        before: of the simulator as given.
        refit: after R, C, R_ex, PEEP were refitted.
        after: of the corrected simulator.
        noise_floor: RMSE of a perfect simulator, cmH2O.
        groups: the same for parts, such as ``{"lung R5C10": {"before": Distance, ...}}``.
    """

    held_out_breaths: tuple[int, ...]
    before: Distance
    refit: Distance
    after: Distance
    noise_floor: float
    groups: dict[str, dict[str, Distance]]


@dataclass(frozen=True)
class LungMatch:
    """The lung that was recorded, and what its label says; R cmH2O s/L, C mL/cmH2O."""

    label: str
    fitted_R: float
    fitted_C: float
    ci95_R: tuple[float, float]
    ci95_C: tuple[float, float]
    label_matches: bool
    source: str  # "pressure" (given the valve's gain) or "pressure and flow"
    settings: tuple[str, ...] = ()  # known settings that it may be, the nearest first


@dataclass(frozen=True, eq=False)
class Traces:
    """Breaths with pressures; all arrays ``(n, T)``, cmH2O, NaN where unknown.

    Attributes:
        breaths: n recorded breaths.
        held_out: which of them no fit has seen, bool ``(n,)``.
        before: the simulator as given.
        refit: with R, C, R_ex, PEEP refitted.
        after: the corrected simulator.
        flow: of the refitted simulator, into the lung, mL/s, or None; pictures are drawn along it.
        volume: likewise, mL.
    """

    breaths: Breaths
    held_out: NDArray[np.bool_]
    before: Floats
    refit: Floats
    after: Floats
    flow: Floats | None = None
    volume: Floats | None = None


@dataclass(frozen=True, eq=False)
class Request:
    """Breaths to record next, since they tell two hypotheses apart.

    Attributes:
        title: in words: what to do on the rig.
        why: the names that they tell apart.
        nats: that they are expected to add.
        u_in: commands, %, ``(k, T)``.
        u_out: 0/1, ``(k, T)``.
        dt: s, ``(k, T)``.
    """

    title: str
    why: tuple[str, ...]
    nats: float
    u_in: Floats
    u_out: Floats
    dt: Floats


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """All that was found.

    Attributes:
        verdict: see :data:`Verdict`.
        mechanisms: what is missing, the most important first.
        slot: where something without a name sits, or None.
        location: where the refitted simulator errs, the surest first.
        open_loop: distances before and after.
        lungs: one for each lung of the recording.
        request: breaths to record next, or None if nothing is left open.
        traces: of all breaths.
        plants: the corrected simulator of each lung, by label.
        plant: what was diagnosed, such as ``physics``.
        noise: standard deviation of the measurement, cmH2O, and correlation between samples.
        notes: what the reader should know, a sentence each.
        seconds: that it took.
    """

    verdict: Verdict
    mechanisms: tuple[Named, ...]
    slot: Slot | None
    location: tuple[Place, ...]
    open_loop: Distances
    lungs: tuple[LungMatch, ...]
    request: Request | None
    traces: Traces
    plants: dict[str, Plant]
    plant: str
    noise: tuple[float, float]
    notes: tuple[str, ...]
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """JSON values of ``diagnosis.json``."""
        from ventbench.diagnosis.as_json import as_dict

        return as_dict(self)
