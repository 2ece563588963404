"""Parameters of the physics: meaning, unit, bounds and priors; and those of the base model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ventbench.base.arrays import Floats

#: Flow of the PVP's inspiratory valve, mL/s per % (137 L/min fully open).
VALVE_GAIN = 22.8

#: Resistance of the expiratory path, cmH2O/(L/s).
EXPIRATORY_RESISTANCE = 5.0


@dataclass(frozen=True)
class Parameter:
    """A scalar parameter, and how a fit is to treat it."""

    name: str  #: short, such as ``delay``.
    unit: str  #: unit of its values, ``1`` if there is none.
    meaning: str  #: what it is, in words.
    low: float  #: lowest plausible and permitted value.
    high: float  #: highest plausible and permitted value.
    neutral: float  #: value at which its mechanism does nothing; of a shape parameter, the default.
    mild: float  #: a small effect that occurs, and where a fit starts.
    strong: float  #: a large effect that occurs.
    #: ``"log"`` for what is positive and known to a factor; else ``"linear"``.
    scale: Literal["linear", "log"] = "linear"
    #: ``"shared"`` by all breaths, or one for each ``"breath"``.
    scope: Literal["shared", "breath"] = "shared"
    #: True for what only shapes the effect (an exponent, a recovery time): it stays at ``neutral``
    #: unless a fit is asked to free it.
    shape: bool = False
    follows: str | None = None  #: ``"R"`` or ``"C"`` if it scales with the lung's R or C.
    #: values that a search must also try, as it may end in the wrong minimum.
    scan: tuple[float, ...] = ()
    #: True for a dead time: the likelihood is flat between two samples and falls off steeply where
    #: an edge passes one, so that its interval is a profile's.
    kinked: bool = False
    #: standard deviation before any data, in coordinates, around ``neutral``; given for what must
    #: stay there where no data bear on it, be it a strength.
    spread: float | None = None
    #: values at which screening tries the mechanism, for a parameter other than the strength that
    #: changes the shape of the effect much; only the neutral value if empty.
    grid: tuple[float, ...] = ()
    #: True if the response has no useful derivative with respect to it, such as a choice between
    #: two rules. A fit holds it at the grid value that screening chose.
    discrete: bool = False
    #: True for a shape parameter whose default is a guess. Final estimates free it, so that the
    #: interval of the strength allows for it.
    uncertain: bool = False
    share: bool = False  #: True for a dimensionless share, which reports show in percent.
    #: True for the position in the recording, 0..1, from which on a change has set in. The
    #: likelihood is constant between two breaths: a fit tries all of them.
    change_point: bool = False

    def __post_init__(self) -> None:
        """Check what the transforms rely on.

        Raises:
            ValueError: if the bounds are out of order or the scale does not fit.
        """
        values = (self.neutral, self.mild, self.strong, *self.grid)
        if not self.low < self.high or not all(self.low <= x <= self.high for x in values):
            raise ValueError(f"{self.name}: {values} must lie within {self.low}..{self.high}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"{self.name}: a log scale needs a positive lower bound")

    def screening_strengths(self) -> tuple[float, ...]:
        """Strengths at which screening evaluates the effect of this parameter's mechanism.

        These are the values of ``scan`` if there are any, else a weak, a mild and a strong effect,
        with both signs where the bounds allow it.
        """
        if self.scan:
            return tuple(value for value in self.scan if value != self.neutral)
        positive = (0.3 * self.mild, self.mild, self.strong)
        return (*positive, *(-value for value in positive if -value >= self.low))

    def coordinate(self, value: ArrayLike) -> Floats:
        """Coordinate of a physical value in a fit: its logarithm on a log scale, else the value.

        A linear scale lets a fit reach ``neutral`` at a bound, with a derivative that is not zero.
        """
        value = np.asarray(value, float)
        return np.log(value) if self.scale == "log" else value

    def physical(self, coordinate: ArrayLike) -> Floats:
        """Inverse of :meth:`coordinate`."""
        coordinate = np.asarray(coordinate, float)
        return np.exp(coordinate) if self.scale == "log" else coordinate

    def slope(self, value: ArrayLike) -> Floats:
        """Derivative of the physical value with respect to the coordinate."""
        value = np.asarray(value, float)
        return value if self.scale == "log" else np.ones_like(value)

    def prior(self) -> tuple[float, float]:
        """Mean and standard deviation, in coordinates, of what is plausible before any data.

        On a log scale the bounds are two standard deviations off; on a linear one, values are
        likeliest near ``neutral``, and half the range off is one standard deviation. ``spread``, if
        it is given, overrules both.
        """
        if self.spread is not None:
            return float(self.coordinate(self.neutral)), self.spread
        low, high = float(self.coordinate(self.low)), float(self.coordinate(self.high))
        if self.scale == "log":
            return 0.5 * (low + high), 0.25 * (high - low)
        return self.neutral, 0.5 * (high - low)


#: Base parameters that every fit frees, so that a wrong label cannot pass for a mechanism.
REFITTED = ("R", "C", "R_ex", "PEEP")

#: Parameters of the base model: the lung, the valves, and how a breath begins. ``neutral`` is the
#: value in a model that does not name the parameter; a model without ``PEEP`` takes the pressure
#: that a breath starts from. R and C stand for a label that must be given.
BASE_PARAMETERS = (
    Parameter(
        "R", "cmH2O/(L/s)", "resistance of the airway", 0.5, 200.0, 20.0, 20.0, 50.0, "log",
        follows="R",
    ),
    Parameter(
        "C", "mL/cmH2O", "compliance of the lung at low volume", 2.0, 250.0, 20.0, 20.0, 50.0,
        "log", follows="C",
    ),
    Parameter(
        "gain", "mL/s per %", "flow of the inspiratory valve", 2.0, 100.0, VALVE_GAIN, VALVE_GAIN,
        VALVE_GAIN, "log",
    ),
    Parameter(
        "R_ex", "cmH2O/(L/s)", "resistance of the expiratory path", 0.3, 100.0,
        EXPIRATORY_RESISTANCE, EXPIRATORY_RESISTANCE, EXPIRATORY_RESISTANCE, "log",
    ),
    Parameter(
        "PEEP", "cmH2O", "pressure behind the expiratory valve", -10.0, 30.0, 5.0, 5.0, 5.0
    ),
    Parameter(
        "rest", "%", "command before the first sample of a breath", 0.0, 100.0, 0.0, 0.0, 0.0,
        shape=True,
    ),
    Parameter(
        "offset", "cmH2O", "recoil minus airway pressure at the first sample", -10.0, 10.0, 0.0,
        0.0, 0.0, shape=True,
    ),
    Parameter(
        "position", "1", "of the breath in its recording, 0 first, 1 last", 0.0, 1.0, 0.0, 0.0,
        1.0, "linear", "breath", shape=True,
    ),
)  # fmt: skip
