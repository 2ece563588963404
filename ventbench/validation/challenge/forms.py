"""Which effects there are, in which forms, how strong; and drawing one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ventbench.errors import InputError
from ventbench.validation.challenge.cases import Effect, Strength

#: A range of a parameter, uniform: low, high.
Range = tuple[float, float]


@dataclass(frozen=True)
class Entry:
    """An effect's strength and what else is drawn.

    Attributes:
        parameter: that carries the strength.
        mild: its mean value.
        strong: likewise.
        forms: of the equation; the first is the library's if ``inside``.
        ranges: of further parameters.
        signs: that the strength may have.
        inside: the library has a mechanism of this name.
    """

    parameter: str
    mild: float
    strong: float
    forms: tuple[str, ...]
    ranges: tuple[tuple[str, Range], ...] = ()
    signs: tuple[float, ...] = (1.0,)
    inside: bool = True


_ONE = ("library",)

ENTRIES: dict[str, Entry] = {
    "valve_delay": Entry("delay", 0.04, 0.08, _ONE),
    "valve_lag": Entry("tau", 0.04, 0.1, ("library", "two lags")),
    "valve_dead_band": Entry("width", 1.5, 3.5, _ONE),
    "valve_curve": Entry(
        "loss", 0.2, 0.5, ("library", "tanh", "exponential", "power law", "convex")
    ),
    "valve_hysteresis": Entry("width", 2.0, 5.0, ("library", "soft play")),
    "command_rounding": Entry("amount", 1.0, 1.0, ("library", "nearest")),
    "supply_droop": Entry(
        "drop", 0.1, 0.3, ("library", "subtractive"), (("recovery", (0.7, 1.5)),)
    ),
    "leak": Entry("conductance", 8.0, 20.0, ("library", "linear", "exponent 0.65")),
    "circuit_compliance": Entry("compliance", 1.2, 3.0, _ONE),
    "inertance": Entry("inertance", 0.04, 0.1, _ONE),
    "turbulent_resistance": Entry("quadratic", 4.0, 10.0, ("library", "exponent 1.75")),
    "nonlinear_compliance": Entry(
        "stiffening", 1 / 40, 1 / 24, ("library", "sigmoid", "quadratic")
    ),
    "viscoelasticity": Entry("ratio", 0.25, 0.7, _ONE, (("time", (0.5, 1.8)),)),
    "sensor_lag": Entry("tau", 0.05, 0.12, _ONE),
    "sensor_drift": Entry("drift", 1.2, 3.0, ("library", "warming"), signs=(1.0, -1.0)),
    "exhalation_valve_delay": Entry("opening", 0.05, 0.1, _ONE),
    "patient_effort": Entry(
        "amplitude",
        2.0,
        5.0,
        ("library", "raised cosine", "trapezoid"),
        (("duration", (0.5, 1.0)),),
    ),
    "volume_resistance": Entry("change", 0.5, 0.65, ("R(V)",), signs=(1.0, -1.0), inside=False),
    "cardiogenic": Entry(
        "amplitude", 0.7, 1.3, ("oscillation",), (("frequency", (1.0, 1.6)),), inside=False
    ),
    "pulsating_supply": Entry(
        "amplitude", 0.115, 0.175, ("oscillation",), (("frequency", (3.0, 7.0)),), inside=False
    ),
    "direction_resistance": Entry("ratio", 1.7, 2.0, ("R(direction)",), inside=False),
    "second_compartment": Entry(
        "share", 0.2, 0.4, ("two compartments",), (("time", (0.5, 1.5)),), inside=False
    ),
    "sensor_nonlinearity": Entry("bend", 0.9, 1.3, ("quadratic",), signs=(1.0, -1.0), inside=False),
    "expiratory_valve_orifice": Entry("amount", 1.0, 1.0, ("orifice",), inside=False),
}

#: Mechanisms of the library, in alphabetical order.
LIBRARY: tuple[str, ...] = tuple(sorted(name for name, e in ENTRIES.items() if e.inside))

#: Effects that the library has no name for.
OUTSIDE: tuple[str, ...] = tuple(sorted(name for name, e in ENTRIES.items() if not e.inside))

#: How far a strength is off its mean, as a share.
_VARIED = 0.15

#: Parameters that are what they are.
_FIXED = ("amount", "share")


def effect(
    name: str, strength: Strength, rng: np.random.Generator, form: str | None = None
) -> Effect:
    """Draw an effect: its strength within 15 % of the mean, its other parameters in their ranges.

    Args:
        name: of the effect.
        strength: ``mild`` or ``strong``.
        rng: what is drawn from.
        form: of its equation; the first of its forms, which is the library's, if None.

    Raises:
        InputError: if there is no such effect or form.
    """
    if name not in ENTRIES:
        raise InputError(f"there is no effect {name!r}; choose one of {', '.join(ENTRIES)}")
    entry = ENTRIES[name]
    form = form or entry.forms[0]
    if form not in entry.forms:
        raise InputError(f"{name} has no form {form!r}; choose one of {', '.join(entry.forms)}")
    varied = 1.0 if entry.parameter in _FIXED else rng.uniform(1 - _VARIED, 1 + _VARIED)
    value = getattr(entry, strength) * varied * rng.choice(np.array(entry.signs))
    further = {key: float(rng.uniform(*span)) for key, span in entry.ranges}
    if name == "direction_resistance":
        value = float(np.clip(value, 1.6, 2.2))
    return Effect(name, strength, form, {entry.parameter: float(value)} | further)


def in_library(item: Effect) -> bool:
    """Tell whether the library has the effect in just this form."""
    entry = ENTRIES[item.name]
    return entry.inside and item.form == entry.forms[0]
