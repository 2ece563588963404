"""``diagnosis.json``: a diagnosis as JSON values; what is not finite becomes null."""

from __future__ import annotations

import math
from typing import Any

import ventbench
from ventbench.diagnosis import words
from ventbench.diagnosis.result import (
    Diagnosis,
    Distance,
    Distances,
    Estimate,
    LungMatch,
    Named,
    Place,
    Request,
    Slot,
)

#: Version of the layout; names are only ever added.
FORMAT = "ventbench-diagnosis-1"


def as_dict(found: Diagnosis) -> dict[str, Any]:
    """JSON values; R in cmH2O s/L, C in mL/cmH2O, errors in cmH2O.

    ``lung`` is the first of ``lungs``, which has all of them.
    """
    lungs = [_lung(match) for match in found.lungs]
    plain = {
        "verdict": found.verdict,
        "mechanisms": [_named(item) for item in found.mechanisms],
        "slot": None if found.slot is None else _slot(found.slot),
        "location": [_place(place) for place in found.location],
        "open_loop": _distances(found.open_loop),
        "lung": lungs[0] if lungs else None,
        "lungs": lungs,
        "request": None if found.request is None else _request(found.request),
        "noise": {"sd": found.noise[0], "correlation": found.noise[1], "unit": "cmH2O"},
        "plant": found.plant,
        "sentences": words.sentences(found),
        "notes": list(found.notes),
        "seconds": found.seconds,
        "format": FORMAT,
        "ventbench": ventbench.__version__,
    }
    return _finite(plain)


def _named(item: Named) -> dict[str, Any]:
    return {
        "name": item.name,
        "parameters": {name: _estimate(value) for name, value in item.parameters.items()},
        "confidence": item.confidence,
        "alternatives": list(item.alternatives),
        "nats": item.nats,
        "changed": item.changed,
        "simulator_has": item.had,
    }


def _estimate(value: Estimate) -> dict[str, Any]:
    return {"value": value.value, "unit": value.unit, "ci95": list(value.ci95)}


def _slot(slot: Slot) -> dict[str, Any]:
    return {
        "name": slot.name,
        "meaning": slot.meaning,
        "explains": slot.explains,
        "nats": slot.nats,
        "shape": {
            "x": slot.x.tolist(),
            "x_unit": slot.x_unit,
            "y": slot.y.tolist(),
            "y_unit": slot.y_unit,
        },
    }


def _place(place: Place) -> dict[str, Any]:
    return {
        "axis": place.axis,
        "range": [place.low, place.high],
        "unit": place.unit,
        "mean_error": place.mean_error,
        "p_value": place.p_value,
        "share": place.share,
    }


def _distance(distance: Distance) -> dict[str, float]:
    return {"mae": distance.mae, "rmse": distance.rmse}


def _distances(distances: Distances) -> dict[str, Any]:
    return {
        "unit": "cmH2O",
        "held_out_breaths": [int(breath) for breath in distances.held_out_breaths],
        "before": _distance(distances.before),
        "refit": _distance(distances.refit),
        "after": _distance(distances.after),
        "noise_floor": distances.noise_floor,
        "groups": {
            name: {stage: _distance(value) for stage, value in group.items()}
            for name, group in distances.groups.items()
        },
    }


def _lung(match: LungMatch) -> dict[str, Any]:
    return {
        "label": match.label,
        "fitted_R": match.fitted_R,
        "fitted_C": match.fitted_C,
        "label_matches": match.label_matches,
        "ci95_R": list(match.ci95_R),
        "ci95_C": list(match.ci95_C),
        "source": match.source,
    }


def _request(request: Request) -> dict[str, Any]:
    """With the commands, so that a rig can run them."""
    return {
        "title": request.title,
        "why": list(request.why),
        "nats": request.nats,
        "u_in": request.u_in.tolist(),
        "u_out": request.u_out.tolist(),
        "dt": request.dt.tolist(),
    }


def _finite(value: Any) -> Any:
    """Plain Python values, None for NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if hasattr(value, "item"):  # a number of numpy's or JAX's
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
