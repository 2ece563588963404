"""What counts as found: names, places, values as a fit with the nominal valve gain sees them."""

from __future__ import annotations

from ventbench.validation.challenge.cases import Case, Effect
from ventbench.validation.challenge.detect import LIMIT
from ventbench.validation.challenge.forms import ENTRIES, in_library

#: Places that are right for an effect outside the library.
SLOTS: dict[str, frozenset[str]] = {
    "volume_resistance": frozenset({"R(V)"}),
    "cardiogenic": frozenset({"f(t) at the alveolus"}),
    "pulsating_supply": frozenset({"f(t) at the supply"}),
    "direction_resistance": frozenset({"R(direction)", "f(Q)"}),
    "second_compartment": frozenset({"memory of p", "memory of V"}),
    "sensor_nonlinearity": frozenset({"measurement"}),
    "expiratory_valve_orifice": frozenset({"exhalation path"}),
}

#: Names that are as good, since the equations are the same seen from pressure alone.
SAME: dict[str, str] = {"second_compartment": "viscoelasticity"}

_NOMINAL = 22.8

#: Power of (true gain / nominal gain) by which a parameter's value changes when flow is thought to
#: have the nominal gain: flows are scaled, pressures are not.
_POWERS = {
    "leak.conductance": -1,
    "circuit_compliance.compliance": -1,
    "inertance.inertance": 1,
    "turbulent_resistance.quadratic": 2,
}


def names(case: Case) -> frozenset[str]:
    """Mechanisms of the library that are in the case."""
    return frozenset(item.name for item in case.effects if ENTRIES[item.name].inside)


def acceptable(case: Case) -> frozenset[str]:
    """The same, and names that are as good."""
    return names(case) | {SAME[item.name] for item in case.effects if item.name in SAME}


def slots(case: Case) -> frozenset[str]:
    """Places that are right."""
    return frozenset().union(*(SLOTS.get(item.name, frozenset()) for item in case.effects))


def seen(case: Case, worth: list[float]) -> frozenset[str]:
    """Effects that are above the detection limit, by their nats."""
    pairs = zip(case.effects, worth, strict=True)
    return frozenset(item.name for item, nats in pairs if nats >= LIMIT)


def values(case: Case) -> dict[str, float]:
    """Parameters by path, of effects that the library has in just this form.

    Those that the library does not fit unless asked (shapes) and those that differ from breath to
    breath are left out, and so is rounding, which is there or not.
    """
    assert case.base is not None
    ratio = case.base.gain / _NOMINAL
    found = {}
    for item in case.effects:
        if in_library(item):
            found |= _of(item, ratio)
    return found


def _of(item: Effect, ratio: float) -> dict[str, float]:
    given = item.parameters
    if item.name == "command_rounding":
        return {}
    if item.name == "patient_effort":
        return {"patient_effort.duration": given["duration"]}
    if item.name == "supply_droop":  # per flow, which is scaled
        k = given["drop"] / (1.0 - given["drop"]) * ratio
        return {"supply_droop.drop": k / (1.0 + k)}
    found = {}
    for key, value in given.items():
        path = f"{item.name}.{key}"
        found[path] = value * ratio ** _POWERS.get(path, 0)
    return found
