"""A diagnosis with its ways out: ``diagnosis.json`` and text."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ventbench
from ventbench import files
from ventbench.diagnosis import report_text
from ventbench.diagnosis.findings import (
    BreathRequest,
    ErrorRegion,
    Findings,
    MissingMechanism,
    NonparametricTerm,
    OpenLoopComparison,
    OpenLoopError,
)
from ventbench.mechanics.lung_match import Estimate, LungMatch

#: Version of the layout of ``diagnosis.json``; keys are only ever added.
FORMAT = "ventbench-diagnosis-1"


@dataclass(frozen=True, eq=False)
class Diagnosis(Findings):
    """What a simulator lacks, by a recording; see :class:`~.findings.Findings` for the fields."""

    def __str__(self) -> str:
        """The diagnosis in sentences, the most important first."""
        return "\n".join(report_text.sentences(self))

    def as_dict(self) -> dict[str, Any]:
        """JSON values of ``diagnosis.json``; numbers that are not finite become None.

        R is in cmH2O s/L, C in mL/cmH2O, errors in cmH2O. ``lung`` is the first of ``lungs``.
        """
        lungs = [_lung(match) for match in self.lungs]
        plain = {
            "verdict": self.verdict,
            "mechanisms": [_mechanism(mechanism) for mechanism in self.mechanisms],
            "slot": None if self.nonparametric is None else _nonparametric(self.nonparametric),
            "location": [_region(region) for region in self.location],
            "open_loop": _open_loop(self.open_loop),
            "lung": lungs[0] if lungs else None,
            "lungs": lungs,
            "request": None if self.request is None else _request(self.request),
            "noise": {"sd": self.noise[0], "correlation": self.noise[1], "unit": "cmH2O"},
            "plant": self.simulator,
            "sentences": report_text.sentences(self),
            "notes": list(self.notes),
            "seconds": self.seconds,
            "settings": self.settings.as_dict(),
            "format": FORMAT,
            "ventbench": ventbench.__version__,
        }
        return files.json_values(plain)


def _mechanism(mechanism: MissingMechanism) -> dict[str, Any]:
    return {
        "name": mechanism.name,
        "parameters": {name: _estimate(value) for name, value in mechanism.parameters.items()},
        "confidence": mechanism.confidence,
        "alternatives": list(mechanism.alternatives),
        "nats": mechanism.nats,
        "changed": mechanism.changed,
        "simulator_has": mechanism.simulator_values,
    }


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {"value": estimate.value, "unit": estimate.unit, "ci95": list(estimate.ci95)}


def _nonparametric(term: NonparametricTerm) -> dict[str, Any]:
    return {
        "name": term.name,
        "meaning": term.meaning,
        "explains": term.explains,
        "nats": term.nats,
        "shape": {
            "x": term.x.tolist(),
            "x_unit": term.x_unit,
            "y": term.y.tolist(),
            "y_unit": term.y_unit,
        },
    }


def _region(region: ErrorRegion) -> dict[str, Any]:
    return {
        "axis": region.axis,
        "range": [region.low, region.high],
        "unit": region.unit,
        "mean_error": region.mean_error,
        "p_value": region.p_value,
        "share": region.share,
    }


def _error(error: OpenLoopError) -> dict[str, float]:
    return {"mae": error.mae, "rmse": error.rmse}


def _open_loop(comparison: OpenLoopComparison) -> dict[str, Any]:
    return {
        "unit": "cmH2O",
        "held_out_breaths": [int(breath) for breath in comparison.held_out_breaths],
        "before": _error(comparison.before),
        "refit": _error(comparison.refit),
        "after": _error(comparison.after),
        "noise_floor": comparison.noise_floor,
        "groups": {
            name: {stage: _error(value) for stage, value in group.items()}
            for name, group in comparison.groups.items()
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


def _request(request: BreathRequest) -> dict[str, Any]:
    """With the commands, so that a rig can run them."""
    return {
        "title": request.title,
        "why": list(request.why),
        "nats": request.nats,
        "u_in": request.u_in.tolist(),
        "u_out": request.u_out.tolist(),
        "dt": request.dt.tolist(),
    }
