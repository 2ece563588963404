"""Coefficients of a regression as quantities of a lung, with intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.mechanics.lung_match import Estimate
from ventbench.mechanics.regression import Solution, Table, effect
from ventbench.mechanics.segments import Segment
from ventbench.mechanics.select import Chosen
from ventbench.mechanics.terms import COLUMNS, TIMES
from ventbench.system_id.intervals import quantile

Floats = NDArray[np.float64]

#: Share by which the quadratic part may be wrong beyond the largest flow that was seen: resistors
#: are not exactly parabolic.
_BEYOND = 0.5


@dataclass(frozen=True)
class Term:
    """What a lung needs beyond R and C.

    Attributes:
        name: of the effect.
        parameters: by short name.
        nats: held-out evidence, natural logarithm of a likelihood ratio.
        effect: what it alone explains, root mean square, cmH2O.
        alternatives: names that would do nearly as well.
    """

    name: str
    parameters: dict[str, Estimate]
    nats: float
    effect: float
    alternatives: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Fitted:
    """Coefficients with covariance, and what follows from them.

    Attributes:
        solution: the fit.
        covariance: of its coefficients.
        table: of its breaths.
        pieces: of the breaths.
        blur: uncertainty of the time over which the flow is integrated, s.
    """

    solution: Solution
    covariance: Floats
    table: Table
    pieces: tuple[Segment, ...]
    blur: float

    def resistance(self, flow: float) -> Estimate:
        """During inspiration, at half of the volume that is inspired."""
        half = 0.5 * self._tidal()

        def value(x: Callable[[str], float]) -> float:
            bent = x("turbulent_resistance") * flow
            return (x("resistance") + bent + x("volume_resistance") * half) * _behind(x)

        found = self._derived(value, "cmH2O s/L")
        top = max(float(piece.flow.max()) for piece in self.pieces)
        beyond = _BEYOND * abs(self._x("turbulent_resistance")) * max(flow - top, 0.0)
        jumps = self.blur * self._x("elastance")
        reach = float(np.linalg.norm([0.5 * (found.ci95[1] - found.ci95[0]), jumps, beyond]))
        return Estimate(found.value, found.unit, (found.value - reach, found.value + reach))

    def compliance(self) -> Estimate:
        """From the start of a breath to the whole of what is inspired."""
        tidal = self._tidal()
        stiff = self._derived(
            lambda x: (x("elastance") + x("nonlinear_compliance") * tidal) * _behind(x), ""
        )
        low, high = (max(end, 1e-3) for end in stiff.ci95)
        return Estimate(1000.0 / stiff.value, "mL/cmH2O", (1000.0 / high, 1000.0 / low))

    def offset(self) -> Estimate:
        """Median over the breaths that are there from their start."""
        values = []
        for piece in (p for p in self.pieces if p.first):
            rows = np.stack([COLUMNS[c].values(piece) for c in self.solution.columns], axis=1)
            left = piece.pressure - rows @ self.solution.x
            values.append(float(np.polyval(np.polyfit(piece.time, left, 1), 0.0)))
        if not values:
            return Estimate(float("nan"), "cmH2O", (float("nan"), float("nan")))
        middle, count = float(np.median(values)), len(values)
        # Of a median; a breath that was cut off in the middle must not count for much.
        spread = 1.25 * 1.4826 * float(np.median(np.abs(np.array(values) - middle)))
        reach = quantile(max(count - 1, 4)) * spread / np.sqrt(count) if count > 1 else np.inf
        return Estimate(middle, "cmH2O", (middle - reach, middle + reach))

    def term(self, item: Chosen) -> Term:
        """Parameters of an effect, in the units of the library where it has it."""
        name = item.name
        if name == "inertance" and self._x(name) < 0.0:
            name = "sensor_lag"
        others = item.alternatives + (("flow_sensor_lag",) if name == "inertance" else ())
        size = effect(self.table, self.solution, item.column)
        return Term(name, self._parameters(name, item.column), item.nats, size, others)

    def _parameters(self, name: str, column: int) -> dict[str, Estimate]:
        simple = {
            "turbulent_resistance": ("quadratic", "cmH2O s2/L2"),
            "inertance": ("inertance", "cmH2O s2/L"),
            "direction_resistance": ("difference", "cmH2O s/L"),
            "volume_resistance": ("slope", "cmH2O s/L2"),
            "expiratory_flow": ("quadratic", "cmH2O s2/L2"),
        }
        if name in simple:
            short, unit = simple[name]
            return {short: self._derived(lambda x: x(name), unit)}
        if name == "nonlinear_compliance":
            made = self._derived(lambda x: 2.0 * x(name) / x("elastance") ** 2, "1/cmH2O")
            return {"stiffening": made}
        if name == "leak":
            made = self._derived(lambda x: 1000.0 * x(name) / x("elastance"), "mL/s per cmH2O")
            return {"conductance": made}
        if name == "sensor_lag":
            return {"tau": self._derived(lambda x: -x("inertance") / x("resistance"), "s")}
        time = COLUMNS[column].time
        assert time is not None
        low = max((t for t in TIMES if t < time), default=time)
        high = min((t for t in TIMES if t > time), default=time)
        return {
            "ratio": self._derived(lambda x: x(name) / x("elastance"), "1"),
            "time": Estimate(time, "s", (low, high)),
        }

    def _derived(self, value: Callable[[Callable[[str], float]], float], unit: str) -> Estimate:
        """A function of the coefficients, with its interval by linear propagation."""
        x = self.solution.x

        def at(point: Floats) -> float:
            named = {
                COLUMNS[c].term: float(v) for c, v in zip(self.solution.columns, point, strict=True)
            }
            return float(value(lambda name: named.get(name, 0.0)))

        step = 1e-4 * np.maximum(np.abs(x), 1e-6)
        slopes = [
            (at(x + h * unit_) - at(x - h * unit_)) / (2.0 * h)
            for h, unit_ in zip(step, np.eye(len(x)), strict=True)
        ]
        sd = float(np.sqrt(max(np.array(slopes) @ self.covariance @ np.array(slopes), 0.0)))
        reach, centre = quantile(max(len(self.table) - 1, 4)) * sd, at(x)
        return Estimate(centre, unit, (centre - reach, centre + reach))

    def _x(self, term: str) -> float:
        names = [COLUMNS[c].term for c in self.solution.columns]
        return float(self.solution.x[names.index(term)]) if term in names else 0.0

    def _tidal(self) -> float:
        """Volume between start and fullest, median over the breaths, L."""
        return float(np.median([np.ptp(piece.volume) for piece in self.pieces]))


def _behind(x: Callable[[str], float]) -> float:
    """Factor of R and 1/C if some of the measured flow leaks away in front of them.

    With a leak g, p = R (Q - g p) + ...: the regression sees R / (1 + R g), and 1/C likewise.
    """
    lost = x("resistance") * x("leak") / x("elastance")
    return 1.0 / (1.0 - min(lost, 0.5))
