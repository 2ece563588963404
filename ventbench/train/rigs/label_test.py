"""Is a rig what its label says? A test of every session against its lung's label.

A session passes if its fitted resistance and compliance are within :data:`TOLERANCE` of the label,
or of what the label's other sessions share, and if its breaths are explained better by its own
label than by any other. Labels are compared by lungs that were fitted without the session, behind
the valve of its kind whose gain may move as much as gains do between rigs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench.plants.hybrid import Hybrid
from ventbench.plants.sessions import Sessions
from ventbench.task.lungs import Lung
from ventbench.train.rigs.data import InspirationData
from ventbench.train.rigs.fit import simulate
from ventbench.train.rigs.parameters import Groups, Pooled, Scales, plants

#: Largest deviation of R and C from the label or from the pooled value, as a share of it.
TOLERANCE = 0.2

#: Flow at which a flow-dependent resistance is compared with its label, L/s.
REFERENCE_FLOW = 0.5

# Gains of the valve that are tried, in standard deviations of a rig's gain; and first pressures
# that are tried where none was recorded, cmH2O.
_GAINS = (-2.0, -1.0, 0.0, 1.0, 2.0)
_STARTS = (5.0, 5.5, 6.0, 6.5, 7.0)
# What one standard deviation of the gain costs, cmH2O of a median error; breaks ties only.
_GAIN_COST = 0.01


@dataclass(frozen=True)
class LabelTest:
    """What the test of one session found.

    Attributes:
        session: index of the session.
        lung: its label.
        measured: breaths whose pressure was measured.
        breaths: all its breaths.
        R: fitted resistance at :data:`REFERENCE_FLOW`, cmH2O/(L/s).
        R_interval: 95 % interval of it.
        R_pooled: resistance that all sessions of the label share.
        C: fitted compliance, mL/cmH2O.
        C_interval: 95 % interval of it.
        C_pooled: compliance that all sessions of the label share.
        error_own_label: median error of its breaths by its own label, cmH2O.
        best_other_label: the label that explains them best among the others; None if there is none.
        error_best_other_label: median error by that one, cmH2O.
    """

    session: int
    lung: Lung
    measured: int
    breaths: int
    R: float
    R_interval: tuple[float, float]
    R_pooled: float
    C: float
    C_interval: tuple[float, float]
    C_pooled: float
    error_own_label: float
    best_other_label: str | None
    error_best_other_label: float | None

    @property
    def reasons(self) -> list[str]:
        """Why the session does not pass, in sentences; empty if it does."""
        out = []
        for name, unit, value, label, pooled in (
            ("R", "cmH2O/(L/s)", self.R, self.lung.R, self.R_pooled),
            ("C", "mL/cmH2O", self.C, self.lung.C, self.C_pooled),
        ):
            if min(abs(value / label - 1.0), abs(value / pooled - 1.0)) > TOLERANCE:
                out.append(
                    f"fitted {name} {value:.1f} {unit} is more than {100 * TOLERANCE:.0f} % from "
                    f"the label {label:g} and from the pooled value {pooled:.1f}"
                )
        other = self.error_best_other_label
        if other is not None and other < self.error_own_label:
            out.append(
                f"its breaths are explained better by {self.best_other_label} (median error "
                f"{other:.2f} cmH2O) than by its own label ({self.error_own_label:.2f})"
            )
        return out

    def as_dict(self) -> dict[str, Any]:
        """Values for the manifest; ``reason`` is there if the session did not pass."""
        row: dict[str, Any] = {
            "session": self.session,
            "lung": self.lung.id,
            "measured": self.measured,
            "breaths": self.breaths,
            "R": round(self.R, 2),
            "R_interval": [round(limit, 2) for limit in self.R_interval],
            "R_pooled": round(self.R_pooled, 2),
            "C": round(self.C, 2),
            "C_interval": [round(limit, 2) for limit in self.C_interval],
            "C_pooled": round(self.C_pooled, 2),
            "error_own_label": round(self.error_own_label, 3),
        }
        if self.best_other_label is not None and self.error_best_other_label is not None:
            row["best_other_label"] = self.best_other_label
            row["error_best_other_label"] = round(self.error_best_other_label, 3)
        if self.reasons:
            row["reason"] = "; ".join(self.reasons)
        return row


def resistance_and_compliance(plant: Hybrid) -> NDArray[np.float64]:
    """R at :data:`REFERENCE_FLOW`, cmH2O/(L/s), and C, mL/cmH2O, of plants; ``(2, ...)``."""
    resistance = np.asarray(plant.R) + REFERENCE_FLOW * np.asarray(plant.K2)
    return np.stack([resistance, 1000.0 / np.asarray(plant.E)])


def interval(value: float, resampled: NDArray[np.float64]) -> tuple[float, float]:
    """Return the 95 % interval of a positive quantity from its values in resampled fits."""
    wide = 1.96 * float(np.std(np.log(resampled), ddof=1)) if len(resampled) > 1 else 0.0
    return float(value * np.exp(-wide)), float(value * np.exp(wide))


@jax.jit
def _errors(
    pooled: Pooled, groups: Groups, gain: Array, start: Array, data: InspirationData
) -> Array:
    plant = plants(pooled, groups)
    plant = plant.replace(slopes=plant.slopes * jnp.exp(gain))  # type: ignore[attr-defined]
    start = jnp.where(data.start_known > 0, data.start, start)
    error = jnp.where(data.share > 0, simulate(plant, start, data) - data.pressure, 0.0)
    return jnp.sum(data.share * jnp.abs(error), axis=1)


def label_errors(
    pooled: Pooled, left_out: Sequence[int], data: InspirationData, labels: Sequence[Lung],
    scales: Scales,
) -> dict[int, list[float]]:  # fmt: skip
    """Median error of the breaths of some sessions under every label, cmH2O.

    Args:
        pooled: a fit that has not seen the sessions, so that they have no deviations of their own.
        left_out: the sessions.
        data: all inspirations.
        labels: the settings, as they are numbered.
        scales: gives the spread of gains.

    Returns:
        For each session the error under each label, in their order.
    """
    # All breaths are simulated, so that every call has one shape and is compiled once.
    session = np.asarray(data.groups.session)
    out: dict[int, list[float]] = {index: [] for index in left_out}
    for number in range(len(labels)):
        groups = dataclasses.replace(data.groups, lung=jnp.full_like(data.groups.lung, number))
        error = np.array([
            np.min([
                np.asarray(_errors(pooled, groups, jnp.asarray(gain * scales.rig_gain),
                                   jnp.asarray(start), data))
                for start in _STARTS
            ], axis=0)
            for gain in _GAINS
        ])  # fmt: skip
        for index in left_out:
            own = np.median(error[:, session == index], axis=1)
            out[index].append(float(np.min(own + _GAIN_COST * np.abs(_GAINS))))
    return out


def label_tests(
    fitted: Pooled,
    resampled: Sequence[Pooled],
    errors: Mapping[int, Sequence[float]],
    sessions: Sessions,
    labels: Sequence[Lung],
    counts: tuple[NDArray[np.int64], NDArray[np.int64]],
    groups: Groups,
) -> list[LabelTest]:
    """Put the tests of all sessions together.

    Args:
        fitted: fit to all breaths.
        resampled: fits to resampled breaths, for intervals.
        errors: see :func:`label_errors`.
        sessions: J sessions.
        labels: the settings, as they are numbered.
        counts: measured and all breaths of each session.
        groups: of the sessions, ``(J,)``.
    """
    values = resistance_and_compliance(plants(fitted, groups))
    again = np.array([resistance_and_compliance(plants(part, groups)) for part in resampled])
    shared = fitted.replace(  # type: ignore[attr-defined]
        **{name: 0.0 * getattr(fitted, name) for name in ("session_R", "session_K2", "session_E")}
    )
    pooled = resistance_and_compliance(plants(shared, groups))
    ids = [lung.id for lung in labels]
    tests = []
    for index, row in enumerate(sessions.table):
        own = ids.index(row.lung)
        (r, c), limits = values[:, index], [
            interval(values[k, index], again[:, k, index] if len(again) else np.empty(0))
            for k in range(2)
        ]  # fmt: skip
        apart = np.where(np.arange(len(ids)) == own, np.inf, errors[index])
        best = int(np.argmin(apart)) if len(ids) > 1 else None
        tests.append(
            LabelTest(
                session=index,
                lung=labels[own],
                measured=int(counts[0][index]),
                breaths=int(counts[1][index]),
                R=float(r),
                R_interval=limits[0],
                R_pooled=float(pooled[0, index]),
                C=float(c),
                C_interval=limits[1],
                C_pooled=float(pooled[1, index]),
                error_own_label=float(errors[index][own]),
                best_other_label=None if best is None else ids[best],
                error_best_other_label=None if best is None else float(apart[best]),
            )
        )
    return tests
