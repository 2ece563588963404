"""ventbench's own diagnosis as a diagnoser, by its public interface.

A verdict becomes probabilities: names by how far each is preferred over its alternatives, places by
their weights, and what the diagnosis cannot know by shares that were set on opened cases.
"""

from __future__ import annotations

from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from proofs.diagnosers.common import see

#: Public places of the diagnosis's places.
_PLACES = {
    "f(u)": "inspiratory_valve", "memory of u": "inspiratory_valve", "f(p)": "circuit",
    "f(Q)": "airway", "R(V)": "airway", "R(direction)": "airway", "f(V)": "lung",
    "memory of p": "lung", "exhalation path": "expiratory_valve",
    "measurement": "pressure_sensor", "f(t) at the alveolus": "muscles",
    "f(t) at the supply": "supply",
}  # fmt: skip

#: Names of what changes in the session: a step, and a drift.
_CHANGES = {"gain": ("gain_step", "gain_drift"), "zero": ("zero_step", "sensor_drift")}

#: Probability of the verdict *nothing missing*; of all stated names together being all there is;
#: of the named place being a place.
_SILENT, _COMPLETE, _PLACED = 0.93, 0.95, 0.9

#: Most hypotheses of alternatives, and least probability of one.
_MOST, _LEAST = 60, 1e-4


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    observed = seen.breaths.select(~seen.apart)
    found = ventbench.diagnose(observed, simulator="physics", lung=seen.label, patient=True)
    answer: dict[str, Any] = {
        "hypotheses": _hypotheses(found),
        "pressures": seen.pressures(_predictions(found, seen, observed)),
        "parameters": _parameters(found, seen.question["vocabulary"]["names"]),
        "notes": found.as_dict(),
    }
    if found.request is not None:
        answer["record_next"] = [
            {"time": np.concatenate([[0.0], np.cumsum(dt[:-1])]), "u_in": u_in,
             "u_out": u_out.astype(int)}
            for u_in, u_out, dt in zip(
                found.request.u_in, found.request.u_out, found.request.dt, strict=True
            )
        ]  # fmt: skip
    return answer


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


def _hypotheses(found: Any) -> list[dict[str, Any]]:
    weights: dict[frozenset[str], float] = {}

    def add(terms: frozenset[str], probability: float) -> None:
        weights[terms] = weights.get(terms, 0.0) + probability

    session = _session(found)
    if found.verdict == "nothing_missing":
        add(frozenset(), _SILENT)
        for place in set(_PLACES.values()):
            add(frozenset({f"unknown:{place}"}), (1.0 - _SILENT) / len(set(_PLACES.values())))
    elif found.mechanisms:
        for terms, probability in _names(found):
            for further, share in _further(found, session):
                add(terms | further, probability * share)
    else:
        for further, share in _further(found, session):
            add(further, share)
    kept = {terms: p for terms, p in weights.items() if p > _LEAST}
    total = sum(kept.values())
    return [{"terms": sorted(terms), "probability": p / total} for terms, p in kept.items()]


def _session(found: Any) -> frozenset[str]:
    """Names of changes in the session, and of a sensor that saturates."""
    names = {_CHANGES[c.of][int(c.drifts)] for c in found.changes if c.of in _CHANGES}
    return frozenset(names | ({"saturation"} if found.saturated is not None else set()))


def _names(found: Any) -> list[tuple[frozenset[str], float]]:
    """Sets of names: each name is replaced by each of its alternatives."""
    choices = []
    for missing in found.mechanisms:
        others = missing.alternatives[:4]
        sure = float(np.clip(missing.confidence, 0.05, 0.99)) if others else 0.99
        rest = [(name, (1.0 - sure) / len(others)) for name in others]
        choices.append([(missing.name, sure), *rest])
    every = (
        (frozenset(name for name, _ in chosen), float(np.prod([p for _, p in chosen])))
        for chosen in product(*choices)
    )
    return list(islice(every, _MOST))


def _further(found: Any, session: frozenset[str]) -> list[tuple[frozenset[str], float]]:
    """What is missing beside the names: changes of the session, and a place without a name."""
    term = found.nonparametric
    if term is None:
        if found.mechanisms or session:
            rest = frozenset({"unknown:airway"}) | session
            return [(session, _COMPLETE), (rest, 1.0 - _COMPLETE)]
        places = sorted(set(_PLACES.values()))
        return [(frozenset({f"unknown:{place}"}), 1.0 / len(places)) for place in places]
    weighed = dict(term.places) or {term.name: 1.0}
    by_place: dict[str, float] = {}
    for name, weight in weighed.items():
        if name in _PLACES:
            by_place[_PLACES[name]] = by_place.get(_PLACES[name], 0.0) + weight
    by_place = by_place or {_PLACES.get(term.name, "airway"): 1.0}
    total = sum(by_place.values())
    others = [place for place in sorted(set(_PLACES.values())) if place not in by_place]
    shares = [(place, _PLACED * weight / total) for place, weight in by_place.items()]
    shares += [(place, (1.0 - _PLACED) / max(len(others), 1)) for place in others]
    return [(session | {f"unknown:{place}"}, share) for place, share in shares]


def _parameters(found: Any, names: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Estimates that the vocabulary has, where both ends of the interval are known."""
    values = {
        f"{missing.name}.{key}": (estimate.value, *estimate.ci95)
        for missing in found.mechanisms
        for key, estimate in missing.parameters.items()
    }
    for missing in found.mechanisms:
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
        values["saturation.level"] = (found.saturated[0],) * 3
    known = {f"{name}.{key}" for name, about in names.items() for key in about["parameters"]}
    return {
        path: {
            "value": float(v),
            "low": min(float(low), float(v)),
            "high": max(float(high), float(v)),
        }
        for path, (v, low, high) in values.items()
        if path in known | {"R", "C"}
        and all(x is not None and np.isfinite(x) for x in (v, low, high))
    }
