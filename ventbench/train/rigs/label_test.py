"""Is a rig what its label says? An absolute test of every session against its lung's label.

From pressures alone, R and C are known up to the gain of the valve: if all flows are ``s`` times
those of the fit, so is C, and a resistor whose drop was read at a flow has it at ``s`` times that
flow. A common error of all gains is therefore no error of any pressure, and comparing sessions with
each other cannot show it. What tells the gain is the resistor: its label says which flow makes its
drop. Test lungs have parabolic resistors, which have their labelled resistance at
:data:`~ventbench.train.rigs.fit.LABEL_FLOW` and less below, by a law between that of an
orifice and one with a laminar share. With the gain that follows, C must be near its label whatever
the law. Where it is not under one of them, or where the drop is so small that tubes could make it,
the label cannot be told, and the session is not called label-true.

Besides, a session's breaths must be explained better by its own label than by any other. Labels are
compared by lungs that were fitted without the session, behind the valve of its kind whose gain may
move as much as gains do between rigs.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.base.arrays import Floats, Ints
from ventbench.plants.hybrid import Hybrid
from ventbench.plants.sessions import Sessions
from ventbench.task.lungs import Lung
from ventbench.train.rigs.data import Groups, InspirationData
from ventbench.train.rigs.fit import LABEL_FLOW, Pooled, Scales, plants, simulate

#: Largest deviation of R and C from the label, as a share of it. Half of it may be left open by
#: the fit and by what lies between sensor and lung.
TOLERANCE = 0.2

#: Flow at which the resistance is read, L/s: most of the recorded inspirations have less than 1.
REFERENCE_FLOW = 0.5

#: Pressures between which the compliance is read, as a chord, cmH2O: PEEP to a middle PIP.
CHORD = (5.0, 25.0)

#: Resistance of what lies between sensor and lung, which is no part of the label: unknown within
#: this, cmH2O/(L/s).
APPARATUS = 1.0

# Gains of the valve that are tried, in standard deviations of a rig's gain; and first pressures
# that are tried where none was recorded, cmH2O.
_GAINS = (-2.0, -1.0, 0.0, 1.0, 2.0)
_STARTS = (5.0, 5.5, 6.0, 6.5, 7.0)
# What one standard deviation of the gain costs, cmH2O of a median error; breaks ties only.
_GAIN_COST = 0.01


def label_gain(R: float, label: float, laminar_share: float) -> float:
    """Factor of all flows that makes a resistance at :data:`REFERENCE_FLOW` that of a label.

    The label's resistor takes ``label * (a Q + (1 - a) Q^2 / LABEL_FLOW)`` at the flow Q.

    Args:
        R: as fitted, cmH2O/(L/s).
        label: labelled resistance, cmH2O/(L/s).
        laminar_share: a, 0 for an orifice and 1 for a linear resistor.
    """
    linear = laminar_share * label
    square = (1.0 - laminar_share) * label * REFERENCE_FLOW / LABEL_FLOW
    return 2.0 * R / (linear + math.sqrt(linear**2 + 4.0 * square * R))


#: What the manifest holds of a test, by the digits after the point.
_DIGITS = {
    2: ("R", "R_interval", "C", "C_interval", "C_by_resistor"),
    3: ("gain", "gain_uncertainty", "error_own_label"),
}


@dataclass(frozen=True)
class LabelTest:
    """What the test of one session found."""

    session: int  #: index of the session.
    lung: Lung  #: its label.
    measured: int  #: breaths whose pressure was measured.
    breaths: int  #: all its breaths.
    R: float  #: resistance at :data:`REFERENCE_FLOW` with the fitted gain, cmH2O/(L/s).
    R_interval: tuple[float, float]  #: 95 % interval of it.
    C: float  #: chord compliance over :data:`CHORD` with the fitted gain, mL/cmH2O.
    C_interval: tuple[float, float]  #: 95 % interval of it.
    #: largest part of the labelled resistance that does not depend on the flow; an orifice has
    #: none, and a linear resistor has 1.
    laminar_share: float
    error_own_label: float  #: median error of its breaths by its own label, cmH2O.
    #: the label that explains them best among the others; None if there is none.
    best_other_label: str | None
    error_best_other_label: float | None  #: median error by that one, cmH2O.

    @property
    def _shares(self) -> tuple[float, ...]:
        """Ends of the laws that the label's resistor may have."""
        return (1.0,) if self.laminar_share == 1.0 else (self.laminar_share, 0.0)

    def _gains(self, R: float) -> Floats:
        return np.array([label_gain(max(R, 1e-3), self.lung.R, share) for share in self._shares])

    @property
    def gain(self) -> tuple[float, float]:
        """True flows over fitted ones, if the resistor is that of the label; by either law."""
        gains = self._gains(self.R)
        return float(gains.min()), float(gains.max())

    @property
    def gain_uncertainty(self) -> float:
        """Further uncertainty of the logarithm of :attr:`gain`: apparatus and fit."""

        def half(low: float, high: float) -> float:
            return 0.5 * float(np.log(self._gains(high) / self._gains(low)).max())

        apparatus = half(self.R - APPARATUS, self.R + APPARATUS)
        return math.hypot(apparatus, half(*self.R_interval) / 1.96)

    @property
    def C_by_resistor(self) -> tuple[float, float]:
        """Compliance with the gain that the label's resistor gives the valve, mL/cmH2O."""
        return self.gain[0] * self.C, self.gain[1] * self.C

    @property
    def reasons(self) -> list[str]:
        """Why the session is not what its label says, in sentences; empty if nothing says so."""
        out, limit = [], f"{100 * TOLERANCE:.0f} %"
        flow = REFERENCE_FLOW / LABEL_FLOW
        at_label = [self.lung.R * (share + (1.0 - share) * flow) for share in self._shares]
        low, high = min(at_label), max(at_label)
        if not low * (1.0 - TOLERANCE) <= self.R <= high * (1.0 + TOLERANCE):
            out.append(
                f"fitted R {self.R:.1f} cmH2O/(L/s) at {REFERENCE_FLOW:g} L/s is more than {limit} "
                f"from what a resistor of the label {self.lung.R:g} has there, {low:g} to {high:g}"
            )
        deviation = self.C / self.lung.C - 1.0
        if abs(deviation) > TOLERANCE:
            out.append(
                f"fitted C {self.C:.1f} mL/cmH2O is {100 * abs(deviation):.0f} % too "
                f"{'high' if deviation > 0 else 'low'} for the label {self.lung.C:g}"
            )
        elif self._identifiable and not any(self._close):
            out.append(
                f"C by the flow that its resistor tells, {self._range} mL/cmH2O, is more than "
                f"{limit} from the label {self.lung.C:g}"
            )
        alternative = self.error_best_other_label
        if alternative is not None and alternative < self.error_own_label:
            out.append(
                f"its breaths are explained better by {self.best_other_label} (median error "
                f"{alternative:.2f} cmH2O) than by its own label ({self.error_own_label:.2f})"
            )
        return out

    @property
    def doubts(self) -> list[str]:
        """Why it cannot be told that the session is what its label says; empty if it can."""
        if not self._identifiable:
            return [
                f"the drop over its resistor tells the gain of the valve, and C, to "
                f"{100 * self.gain_uncertainty:.0f} % only"
            ]
        if not all(self._close):
            return [f"C is {self._range} mL/cmH2O by the laws that its resistor may have"]
        return []

    @property
    def label_true(self) -> bool:
        """Whether the session is what its label says, and that can be told."""
        return not self.reasons and not self.doubts

    @property
    def _identifiable(self) -> bool:
        return self.gain_uncertainty <= 0.5 * math.log1p(TOLERANCE)

    @property
    def _close(self) -> list[bool]:
        return [abs(C / self.lung.C - 1.0) <= TOLERANCE for C in self.C_by_resistor]

    @property
    def _range(self) -> str:
        return " to ".join(f"{C:.1f}" for C in self.C_by_resistor)

    def as_dict(self) -> dict[str, Any]:
        """Values for the manifest; ``reason`` or ``doubt`` if it is not label-true."""
        row: dict[str, Any] = {
            "session": self.session,
            "lung": self.lung.id,
            "measured": self.measured,
            "breaths": self.breaths,
        }
        for digits, names in _DIGITS.items():
            row |= {name: np.round(getattr(self, name), digits).tolist() for name in names}
        if self.best_other_label is not None and self.error_best_other_label is not None:
            row["best_other_label"] = self.best_other_label
            row["error_best_other_label"] = round(self.error_best_other_label, 3)
        if self.reasons:
            row["reason"] = "; ".join(self.reasons)
        elif self.doubts:
            row["doubt"] = "; ".join(self.doubts)
        return row


def resistance_and_compliance(plant: Hybrid) -> Floats:
    """R at :data:`REFERENCE_FLOW` and C over :data:`CHORD` of plants, shape ``(2, ...)``."""
    resistance = np.asarray(plant.R) + REFERENCE_FLOW * np.asarray(plant.K2)
    elastance = np.asarray(plant.E, float)
    # The elastic curve is made of straight parts between whole numbers.
    elastic = np.arange(0.0, 1001.0).reshape(-1, *(1,) * elastance.ndim)
    recoil = np.asarray(plant.recoil(jnp.asarray(elastic))[0], float)
    recoil = np.broadcast_to(recoil, (len(elastic), *elastance.shape)).reshape(len(elastic), -1)
    low, high = np.array([np.interp(CHORD, curve, elastic.ravel()) for curve in recoil.T]).T
    volume = 1000.0 * (high - low).reshape(elastance.shape) / elastance
    return np.stack([resistance, volume / (CHORD[1] - CHORD[0])])


def interval(value: float, resampled: Floats) -> tuple[float, float]:
    """Return the 95 % interval of a positive quantity from its values in resampled fits."""
    half_width = 1.96 * float(np.std(np.log(resampled), ddof=1)) if len(resampled) > 1 else 0.0
    return float(value * np.exp(-half_width)), float(value * np.exp(half_width))


@jax.jit
def _errors(
    pooled: Pooled, groups: Groups, gain: Array, start: Array, data: InspirationData
) -> Array:
    plant = plants(pooled, groups)
    plant = plant.replace(slopes=plant.slopes * jnp.exp(gain))  # type: ignore[attr-defined]
    start = jnp.where(data.start_measured > 0, data.start, start)
    error = jnp.where(data.share > 0, simulate(plant, start, data) - data.pressure, 0.0)
    return jnp.sum(data.share * jnp.abs(error), axis=1)


def label_errors(
    pooled: Pooled,
    held_out: Sequence[int],
    data: InspirationData,
    labels: Sequence[Lung],
) -> dict[int, list[float]]:
    """Median error of the breaths of some sessions under every label, cmH2O.

    Args:
        pooled: a fit that has not seen the sessions, so that they have no deviations of their own.
        held_out: the sessions.
        data: all inspirations.
        labels: the settings, as they are numbered.

    Returns:
        For each session the error under each label, in their order.
    """
    # All breaths are simulated, so that every call has one shape and is compiled once.
    session = np.asarray(data.groups.session)
    out: dict[int, list[float]] = {index: [] for index in held_out}
    for number in range(len(labels)):
        groups = dataclasses.replace(data.groups, lung=jnp.full_like(data.groups.lung, number))
        each = [
            _errors(pooled, groups, jnp.asarray(gain * Scales().rig_gain), jnp.asarray(start), data)
            for gain in _GAINS
            for start in _STARTS
        ]
        error = np.reshape(each, (len(_GAINS), len(_STARTS), -1)).min(axis=1)
        for index in held_out:
            medians = np.median(error[:, session == index], axis=1)
            out[index].append(float(np.min(medians + _GAIN_COST * np.abs(_GAINS))))
    return out


def label_tests(
    fitted: Hybrid,
    resampled: Sequence[Hybrid],
    errors: Mapping[int, Sequence[float]],
    sessions: Sessions,
    labels: Sequence[Lung],
    counts: tuple[Ints, Ints],
    laminar_share: float,
) -> list[LabelTest]:
    """Put the tests of all sessions together.

    Args:
        fitted: plants of the J sessions, fitted to all breaths, leaves ``(J, ...)``.
        resampled: those fitted to resampled breaths, for intervals.
        errors: see :func:`label_errors`.
        sessions: J sessions.
        labels: the settings, as they are numbered.
        counts: measured and all breaths of each session.
        laminar_share: see :class:`LabelTest`.
    """
    values = resistance_and_compliance(fitted)
    refits = [resistance_and_compliance(part) for part in resampled]
    refits = np.reshape(refits, (-1, *values.shape))
    ids = [lung.id for lung in labels]
    tests = []
    for index, row in enumerate(sessions.table):
        labelled = ids.index(row.lung)
        r, c = values[:, index]
        limits = [interval(values[k, index], refits[:, k, index]) for k in range(2)]
        alternatives = np.where(np.arange(len(ids)) == labelled, np.inf, errors[index])
        best = int(np.argmin(alternatives)) if len(ids) > 1 else None
        tests.append(
            LabelTest(
                session=index,
                lung=labels[labelled],
                measured=int(counts[0][index]),
                breaths=int(counts[1][index]),
                R=float(r),
                R_interval=limits[0],
                C=float(c),
                C_interval=limits[1],
                laminar_share=laminar_share,
                error_own_label=float(errors[index][labelled]),
                best_other_label=None if best is None else ids[best],
                error_best_other_label=None if best is None else float(alternatives[best]),
            )
        )
    return tests
