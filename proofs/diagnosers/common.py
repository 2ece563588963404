"""What several diagnosers need: the case, the breaths that they see, and predictions of the others.

The model and its fits are those of :mod:`ventbench.system_id`, so that rivals differ in what they
conclude, not in the lung that they know.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ventbench.base import compilation
from ventbench.recordings import load
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import START, Data, Fit, Predictor, make_data, parameter_values

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Seen:
    """A case as a diagnoser sees it."""

    question: Mapping[str, Any]  #: content of ``case.json``.
    breaths: Breaths  #: all breaths, in order.
    apart: NDArray[np.bool_]  #: which of them are withheld, ``(n,)``.

    @cached_property
    def data(self) -> Data:
        """All breaths as data; withheld readings have no weight."""
        return make_data(self.breaths)

    @property
    def observed(self) -> Data:
        """The breaths with pressures."""
        return self.data.select(~self.apart)

    @property
    def label(self) -> str:
        """The lung's label, such as ``R20C50``."""
        return f"R{self.question['label']['R']:g}C{self.question['label']['C']:g}"

    def pressures(self, predicted: Floats) -> dict[str, list[float]]:
        """Predictions of the withheld breaths, ``(k, T)``, as an answer has them."""
        ids = self.breaths.breath_id[self.apart]
        counts = self.breaths.valid[self.apart].sum(axis=1)
        return {
            str(breath): row[:count].tolist()
            for breath, row, count in zip(ids.tolist(), predicted, counts, strict=True)
        }


def see(folder: Path) -> Seen:
    """Read the folder of a case; compiled functions are kept on the disk."""
    compilation.keep()
    question = json.loads((folder / "case.json").read_text())
    breaths = load(folder / question["recording"])
    return Seen(question, breaths, np.isin(breaths.breath_id, question["withheld"]))


def estimated(value: float, low: float, high: float) -> dict[str, float]:
    """A parameter and its 95 % interval, as an answer has them."""
    return {"value": float(value), "low": float(min(low, value)), "high": float(max(high, value))}


def intervals(fitted: Fit, paths: Iterable[str]) -> dict[str, dict[str, float]]:
    """Estimates of free parameters with their 95 % intervals."""
    return {path: estimated(fitted.value(path)[0], *fitted.ci95(path)[0]) for path in paths}


@dataclass(frozen=True, eq=False)
class Refitted:
    """A refitted model over all breaths, for rivals that explain what it leaves."""

    pressure: Floats  #: the model's pressures, cmH2O, ``(n, T)``.
    flow: Floats  #: its flow into the lung, L/s, ``(n, T)``.
    residual: Floats  #: recorded minus modelled, cmH2O, 0 where ``weight`` is, ``(n, T)``.
    weight: Floats  #: 1 where a pressure is recorded, but for the first sample, ``(n, T)``.


def simulated(seen: Seen, fitted: Fit) -> Refitted:
    """Simulate all breaths by a refit; withheld ones start from the mean start of the others."""
    data = seen.data
    two = np.concatenate([data.measured, np.zeros_like(data.measured)], axis=1)
    weight = np.concatenate([data.weight, np.zeros_like(data.weight)], axis=1)
    simulator = Predictor(
        replace(data, measured=two, weight=weight), fitted.problem.predictor.names
    )
    values = parameter_values(data, simulator.names, {})
    for path in ("R", "C", "R_ex", "PEEP", START):
        column = (*simulator.names, START).index(path)
        values[:, column] = np.mean(fitted.column(path))
    values[~seen.apart, -1] = fitted.column(START)
    pressure, flow = np.moveaxis(simulator.predict(values), 1, 0)
    counted = data.weight[:, 0].copy()
    counted[:, 0] = 0.0
    return Refitted(pressure, 1e-3 * flow, counted * (data.measured[:, 0] - pressure), counted)
