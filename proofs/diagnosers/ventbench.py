"""ventbench's own diagnosis as a diagnoser, by its public interface.

A verdict becomes probabilities: names by how far each is preferred over its alternatives, places by
their weights, and what the diagnosis cannot know by shares that were fitted on opened cases.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np

import ventbench
from proofs.diagnosers.common import see
from ventbench.physics.catalogue import library

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


@dataclass(frozen=True)
class Calibration:
    """Shares that the verdicts deserve, 0..1.

    Attributes:
        nothing: of the verdict *nothing missing*; else an effect was overlooked.
        named: of the stated names being all there is.
        placed: of a place without a name being the place.
        alone: of what is left where a verdict fails, that there is nothing beside the names.
        foreign: of an effect without a name, that it is one of those names of the vocabulary for
            which the diagnosis has no hypothesis, all alike; else it is at any place.
        doubt: power of the unexplained error, in multiples of the noise from 1 on, by which the
            odds of a verdict fall that leaves nothing open.
    """

    nothing: float
    named: float
    placed: float
    alone: float
    foreign: float
    doubt: float


#: Fitted on opened cases by ``benchmarks/adapter_calibration.py``.
CALIBRATION = Calibration(
    nothing=0.87, named=0.87, placed=0.21, alone=0.24, foreign=0.95, doubt=3.6
)

#: Most hypotheses of alternatives and of all, and least probability of one.
_MOST, _ALL, _LEAST = 60, 400, 1e-4


def diagnose(folder: Path) -> dict[str, Any]:
    """Answer a case."""
    seen = see(folder)
    observed = seen.breaths.select(~seen.apart)
    found = ventbench.diagnose(observed, simulator="physics", lung=seen.label, patient=True)
    notes = found.as_dict()
    answer: dict[str, Any] = {
        "hypotheses": hypotheses(notes, seen.question["vocabulary"]),
        "pressures": seen.pressures(_predictions(found, seen, observed)),
        "parameters": _parameters(found, seen.question["vocabulary"]["names"]),
        "notes": notes,
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


def hypotheses(
    found: Mapping[str, Any], vocabulary: Mapping[str, Any], shares: Calibration = CALIBRATION
) -> list[dict[str, Any]]:
    """Probabilities of a verdict.

    What the verdict says has the share that such verdicts deserve. The rest goes to what it may
    have missed: nothing beside the stated names, one effect more, or another in their place.

    Args:
        found: a diagnosis as JSON values.
        vocabulary: that of the case.
        shares: see :class:`Calibration`.
    """
    names, places = vocabulary["names"], vocabulary["places"]
    foreign = sorted(names.keys() - {*library(), "saturation"})
    session = _session(found)
    stated = [(terms | session, p) for terms, p in _names(found, names)]
    main, slot = stated[0][0], found["slot"]
    weights: dict[frozenset[str], float] = {}

    def add(terms: frozenset[str], probability: float) -> None:
        weights[terms] = weights.get(terms, 0.0) + probability

    def unnamed(base: frozenset[str], probability: float, named: list[str], at: list[str]) -> None:
        share = shares.foreign if named else 0.0
        for name in named:
            add(base | {name}, probability * share / len(named))
        for place in at:
            add(base | {f"unknown:{place}"}, probability * (1.0 - share) / len(at))

    if slot is not None:
        told = shares.placed
        for place, weight in _by_place(slot).items():
            at = [name for name in foreign if names[name]["place"] == place]
            for terms, probability in stated:
                unnamed(terms, told * weight * probability, at, [place])
    elif main or found["verdict"] == "nothing_missing":
        told = _doubted(shares.named if main else shares.nothing, found["open_loop"], shares.doubt)
        for terms, probability in stated:
            add(terms, told * probability)
    else:
        told = 0.0
    # Where nothing more is the verdict itself, it cannot be what the verdict missed.
    alone = shares.alone if slot is not None or not told else 0.0
    add(main, (1.0 - told) * alone)
    bases = {main, frozenset()}
    for base in bases:
        unnamed(base, (1.0 - told) * (1.0 - alone) / len(bases), foreign, places)
    likely = sorted(weights, key=weights.__getitem__, reverse=True)[:_ALL]
    kept = {terms: weights[terms] for terms in likely if weights[terms] > _LEAST}
    total = sum(kept.values())
    return [{"terms": sorted(terms), "probability": p / total} for terms, p in kept.items()]


def _doubted(share: float, errors: Mapping[str, Any], doubt: float) -> float:
    """A share after a look at what stays unexplained."""
    beyond = (errors["unexplained"] or 0.0) / (errors["noise_floor"] or np.inf)
    odds = share / (1.0 - share) * max(beyond, 1.0) ** -doubt
    return odds / (1.0 + odds)


def _session(found: Mapping[str, Any]) -> frozenset[str]:
    """Names of changes in the session, and of a sensor that saturates."""
    changes = found["changes"]
    names = {_CHANGES[c["of"]][int(c["drifts"])] for c in changes if c["of"] in _CHANGES}
    return frozenset(names | ({"saturation"} if found["saturated"] is not None else set()))


def _names(found: Mapping[str, Any], known: Any) -> list[tuple[frozenset[str], float]]:
    """Sets of names, the stated ones first: each is replaced by each known alternative."""
    choices = []
    for missing in found["mechanisms"]:
        others = [name for name in missing["alternatives"] if name in known][:4]
        sure = float(np.clip(missing["confidence"], 0.05, 0.99)) if others else 1.0
        rest = [(name, (1.0 - sure) / len(others)) for name in others]
        choices.append([(missing["name"], sure), *rest])
    every = (
        (frozenset(name for name, _ in chosen), float(np.prod([p for _, p in chosen])))
        for chosen in product(*choices)
    )
    return list(islice(every, _MOST))


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
