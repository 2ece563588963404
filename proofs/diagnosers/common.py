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
from ventbench.physics.catalogue import library, mechanism
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

    def predict(self, fitted: Fit) -> Floats:
        """Pressures of the withheld breaths by a fitted model, cmH2O, ``(k, T)``.

        They start from the mean start of the fitted breaths, and so does what each breath has of
        its own.
        """
        test = self.data.select(self.apart)
        simulator = Predictor(test, fitted.problem.predictor.names)
        values = parameter_values(test, simulator.names, {})
        for column, name in enumerate((*simulator.names, START)):
            if name != "position":
                values[:, column] = np.mean(fitted.column(name))
        return simulator.predict(values)[:, 0]


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
class Templates:
    """A refitted model to first order, over all breaths, for rivals that are linear."""

    pressure: Floats  #: the model's pressures, cmH2O, ``(n, T)``.
    flow: Floats  #: its flow into the lung, L/s, ``(n, T)``.
    residual: Floats  #: recorded minus modelled, cmH2O, 0 where ``weight`` is, ``(n, T)``.
    weight: Floats  #: 1 where a pressure is recorded, but for the first sample, ``(n, T)``.
    refit: Floats  #: changes of pressure by R, C, R_ex and PEEP, ``(4, n, T)``.
    #: change of pressure by each mechanism at its mild strength, ``(n, T)``, by name.
    effects: dict[str, Floats]


#: Relative step of R, C and R_ex, and step of PEEP, cmH2O, of a refit to first order.
_STEPS = {"R": 0.05, "C": 0.05, "R_ex": 0.05, "PEEP": 0.2}


def templates(seen: Seen, fitted: Fit, names: Iterable[str]) -> Templates:
    """Linearise a refit in its parameters, and in the strengths of mechanisms."""
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
    first = simulator.predict(values)

    def changed(new: Mapping[str, float]) -> Floats:
        moved = values.copy()
        for path, value in new.items():
            moved[:, simulator.names.index(path)] = value
        return simulator.predict(moved)[:, 0] - first[:, 0]

    def stepped(path: str, step: float) -> Floats:
        value = float(values[0, simulator.names.index(path)])
        return changed({path: value + (step if path == "PEEP" else step * value)})

    counted = data.weight[:, 0].copy()
    counted[:, 0] = 0.0
    return Templates(
        first[:, 0],
        1e-3 * first[:, 1],
        counted * (data.measured[:, 0] - first[:, 0]),
        counted,
        np.stack([stepped(path, step) for path, step in _STEPS.items()]),
        {
            name: changed(
                {
                    f"{name}.{p.name}": p.mild
                    for p in mechanism(name).description.parameters
                    if not p.shape
                }
            )
            for name in names
        },
    )


def candidates() -> tuple[str, ...]:
    """Mechanisms of the library, but for efforts, which differ from breath to breath."""
    return tuple(name for name in library() if name != "patient_effort")


def strength(name: str, multiple: float) -> dict[str, dict[str, float]]:
    """Estimate of a strength as a multiple of the mild one, without an interval of its own."""
    about = mechanism(name).description.strength
    value = about.neutral + multiple * (about.mild - about.neutral)
    return {f"{name}.{about.name}": estimated(value, value, value)}
