"""ventbench's own diagnosis as a diagnoser, by its public interface.

Its posterior is passed on, beside what held-out breaths accept of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from proofs.diagnosers.common import estimated, see
from ventbench.physics.catalogue import basis_terms, mechanism

#: Public places of the diagnosis's places.
_PLACES = {
    "f(u)": "inspiratory_valve",
    "memory of u": "inspiratory_valve",
    "f(p)": "circuit",
    "f(Q)": "airway",
    "R(V)": "airway",
    "R(direction)": "airway",
    "f(V)": "lung",
    "memory of p": "lung",
    "exhalation path": "expiratory_valve",
    "measurement": "pressure_sensor",
    "f(t) at the alveolus": "muscles",
    "f(t) at the supply": "supply",
    "f(t) in the circuit": "circuit",
}

#: Names of what changes in the session: a step, and a drift.
_CHANGES = {"gain": ("gain_step", "gain_drift"), "zero": ("zero_step", "sensor_drift")}


#: Public places of the sites of basis terms, where they differ.
_SITES = {
    "inspiratory valve": "inspiratory_valve",
    "alveolus": "lung",
    "sensor": "pressure_sensor",
    "command": "inspiratory_valve",
    "expiratory valve": "expiratory_valve",
}


@dataclass(frozen=True)
class Calibration:
    """Shares of the probability, fitted on opened cases (``benchmarks/adapter_calibration.py``)."""

    accepted: float = 0.8  #: of what held-out breaths accept, beside the posterior of the search.
    unsure: float = 0.02  #: of all places together.


CALIBRATION = Calibration()

#: Share by which logs round readings.
_ROUNDED = 1e-6

#: Most hypotheses.
_MOST = 100


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    observed = seen.breaths.select(~seen.apart)
    found = ventbench.diagnose(observed, simulator="physics", lung=seen.label, patient=True)
    notes = found.as_dict()
    return {
        "hypotheses": hypotheses(notes, seen.question["vocabulary"]),
        "pressures": seen.pressures(_predictions(found, seen, observed)),
        "parameters": _parameters(found, seen.question["vocabulary"]["names"]),
        "notes": notes,
    }


def _predictions(found: Any, seen: Any, observed: Any) -> Any:
    """Pressures of the withheld breaths by the corrected simulator, from the usual start."""
    withheld = seen.breaths.select(seen.apart)
    start = float(np.nanmedian(observed.pressure[:, 0]))
    simulators = ventbench.load_simulators(found.plants)
    return np.stack(
        [
            simulators.respond(seen.label, u_in, u_out, dt, initial_pressure=start)
            for u_in, u_out, dt in zip(withheld.u_in, withheld.u_out, withheld.dt, strict=True)
        ]
    )


def hypotheses(
    found: Mapping[str, Any], vocabulary: Mapping[str, Any], shares: Calibration = CALIBRATION
) -> list[dict[str, Any]]:
    """Probabilities of a diagnosis: the posterior of its search, and what held-out breaths accept.

    Args:
        found: a diagnosis as JSON values.
        vocabulary: that of the case.
        shares: weights of both.
    """
    always, places = _session(found), vocabulary["places"]
    known = vocabulary["names"].keys() | {f"unknown:{place}" for place in places}
    odds: dict[frozenset[str], float] = {}

    def add(terms: frozenset[str], probability: float) -> None:
        terms = (terms | always) & known
        odds[terms] = odds.get(terms, 0.0) + probability

    for place in places:
        add(frozenset({f"unknown:{place}"}), shares.unsure / len(places))
    whole = sum(each["probability"] for each in found["posterior"])
    for each in found["posterior"]:
        terms = frozenset(_public(name) for name in each["terms"])
        add(terms, (1.0 - shares.unsure) * (1.0 - shares.accepted) * each["probability"] / whole)
    named = frozenset(missing["name"] for missing in found["mechanisms"])
    unknown = {} if found["slot"] is None else _by_place(found["slot"])
    if not named and not unknown and found["verdict"] == "unnamed":
        unknown = dict.fromkeys(places, 1.0 / len(places))
    for place, weight in (unknown or {"": 1.0}).items():
        at = {f"unknown:{place}"} if place else set()
        for names, probability in _swapped(named, found).items():
            add(names | at, (1.0 - shares.unsure) * shares.accepted * weight * probability)
    kept = sorted(odds.items(), key=lambda pair: -pair[1])[:_MOST]
    total = sum(probability for _, probability in kept)
    return [{"terms": sorted(terms), "probability": p / total} for terms, p in kept]


def _swapped(named: frozenset[str], found: Mapping[str, Any]) -> dict[frozenset[str], float]:
    """Probabilities of the named set, and of those with a rival of one effect in its place.

    Held-out breaths accept what is named; they do not choose between it and its rivals.
    """
    sets = [(each["terms"], each["probability"]) for each in found["posterior"]]

    def weight(name: str, rival: str) -> float:
        return sum(p for terms, p in sets if name in terms and rival not in terms)

    odds = {named: 1.0}
    for missing in found["mechanisms"]:
        name = missing["name"]
        for other in missing["alternatives"]:
            odds[named - {name} | {other}] = weight(other, name) / (weight(name, other) or np.inf)
    total = sum(odds.values())
    return {names: each / total for names, each in odds.items()}


def _public(name: str) -> str:
    """A term in the words of the vocabulary."""
    if name not in basis_terms():
        return name
    site = mechanism(name).description.site
    return f"unknown:{_SITES.get(site, site)}"


def _session(found: Mapping[str, Any]) -> frozenset[str]:
    """Names of changes in the session, and of a sensor that saturates."""
    changes = found["changes"]
    names = {_CHANGES[c["of"]][int(c["drifts"])] for c in changes if c["of"] in _CHANGES}
    return frozenset(names | ({"saturation"} if found["saturated"] is not None else set()))


def _by_place(slot: Mapping[str, Any]) -> dict[str, float]:
    """Weights of public places of a term without a name."""
    weighed = dict(slot["places"]) or {slot["name"]: 1.0}
    found: dict[str, float] = {}
    for name, weight in weighed.items():
        place = _PLACES.get(name, "airway")
        found[place] = found.get(place, 0.0) + weight
    total = sum(found.values())
    return {place: weight / total for place, weight in found.items()}


def _parameters(found: Any, names: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Estimates that the vocabulary has, where both ends of the interval are known."""
    values: dict[str, tuple[float, float, float]] = {}
    for missing in found.mechanisms:
        for key, estimate in missing.parameters.items():
            values[f"{missing.name}.{key}"] = (estimate.value, *estimate.ci95)
        if missing.breaths is not None:
            values[f"{missing.name}.breath"] = missing.breaths
    for match in found.lungs[:1]:
        values |= {"R": (match.fitted_R, *match.ci95_R), "C": (match.fitted_C, *match.ci95_C)}
    for change in found.changes:
        if change.of in _CHANGES and not change.drifts:
            name = _CHANGES[change.of][0]
            size = change.size - 1.0 if change.of == "gain" else change.size
            values[f"{name}.change"] = (size, size, size)
            values[f"{name}.breath"] = (change.breath, change.breath, change.breath)
    if found.saturated is not None:
        level = found.saturated[0]  # as the log rounds it
        values["saturation.level"] = (level, level * (1.0 - _ROUNDED), level * (1.0 + _ROUNDED))
    known = {f"{name}.{key}" for name, about in names.items() for key in about["parameters"]}
    return {
        path: estimated(*triple)
        for path, triple in values.items()
        if path in known | {"R", "C"} and all(x is not None and np.isfinite(x) for x in triple)
    }
