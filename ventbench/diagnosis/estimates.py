"""Parameters with intervals, lungs and plants of a conclusion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ventbench import mechanics
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Partition, varies_by_breath
from ventbench.diagnosis.patient_effort import EFFORT
from ventbench.interfaces import Plant
from ventbench.mechanics.lung_match import Estimate, LungMatch
from ventbench.physics.catalogue import library, mechanism, parameter, paths
from ventbench.physics.model import Physics
from ventbench.precision import float64
from ventbench.recordings.breaths import Breaths
from ventbench.system_id import Fit, fit, interval
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.derivatives import START, Simulator


def estimated(fitted: FittedModel, partition: Partition, evaluator: Evaluator) -> Fit:
    """Fit a conclusion's hypothesis to a side's breaths, with covariance.

    Args:
        fitted: the conclusion, on some of the breaths.
        partition: breaths to fit.
        evaluator: that it was found on.
    """
    hypothesis = fitted.hypothesis
    own = [path for path in paths(hypothesis.names) if "." in path]
    free = [path for path in own if parameter(path).uncertain]
    start: dict[str, Any] = {}
    for path in fitted.problem.unknowns.paths:
        if path != START and not ("." in path and varies_by_breath(path.rpartition(".")[0])):
            start[path] = float(np.median(fitted.column(path)))
    for name in hypothesis.names:
        for pair in mechanism(name).description.interchangeable:
            first, second = (f"{name}.{each}" for each in pair)
            if {first, second} <= set(start) and start[second] > start[first]:
                start[first], start[second] = start[second], start[first]
    known = fitted.problem.data
    if len(np.unique(known.lung)) > 1:
        same = (partition.data.R[:, None] == known.R) & (partition.data.C[:, None] == known.C)
        start |= {path: fitted.column(path)[np.argmax(same, axis=1)] for path in ("R", "C")}
    if EFFORT in hypothesis.names:  # each breath's own are looked for where it is likeliest
        near = evaluator.fit(
            hypothesis, fitted.noise, start=start, partition=partition, restart=True
        )
        start |= {path: near.column(path) for path in near.problem.unknowns.paths}
    return fit(
        partition.data,
        hypothesis.names,
        free=dict.fromkeys((*hypothesis.free, *free)),
        fixed=dict(hypothesis.fixed),
        start=start,
        noise=fitted.noise,
        simulator=partition.simulator,
    )


def parameters(found: Fit, name: str) -> dict[str, Estimate]:
    """Values and intervals of a mechanism; of what is each breath's own, over the breaths."""
    values = {}
    for item in mechanism(name).description.parameters:
        path = f"{name}.{item.name}"
        if path not in found.problem.unknowns.paths:
            continue
        if item.scope == "breath":
            column = found.column(path)
            low, middle, high = np.quantile(column, [0.025, 0.5, 0.975])
            values[item.name] = Estimate(float(middle), item.unit, (float(low), float(high)))
        else:
            one = interval(found, path)
            values[item.name] = Estimate(one.value, item.unit, (one.low, one.high))
    return values


def lungs(found: Fit) -> tuple[LungMatch, ...]:
    """R and C of each label as the model has them, and whether the label can be right.

    Judged as :func:`~ventbench.mechanics.match_labels` does, at the flow that labels hold for.
    """
    settings, matches = mechanics.settings_by_label(found), []
    for group, one in enumerate(mechanics.match_labels(found)):
        ends = {path: found.ci95(path)[group] for path in ("R", "C")}
        matches.append(
            replace(
                one,
                fitted_R=float(found.value("R")[group]),
                fitted_C=float(found.value("C")[group]),
                ci95_R=(float(ends["R"][0]), float(ends["R"][1])),
                ci95_C=(float(ends["C"][0]), float(ends["C"][1])),
                settings=tuple(item.id for item in settings[one.label]),
            )
        )
    return tuple(matches)


def lungs_by_flow(breaths: Breaths) -> tuple[tuple[LungMatch, ...], tuple[str, ...]]:
    """The same from pressure and flow or volume, whatever the valve did; and what to know of it.

    Raises:
        InputError: if too little of them is recorded.
    """
    found = mechanics.identify(breaths)
    matches = [
        replace(one.match, settings=tuple(item.id for item in one.settings)) for one in found
    ]
    return tuple(matches), tuple(note for one in found for note in one.notes)


def plants(found: Fit) -> dict[str, Plant]:
    """The fitted plant of each lung, by label, without what each breath has of its own."""
    problem = found.problem
    return _by_label(problem.data, problem.simulator, found.mechanisms, found.values)


def plants_of(fitted: FittedModel, evaluator: Evaluator) -> dict[str, Plant]:
    """The same of a hypothesis as it was fitted to the training breaths of a bench."""
    partition = evaluator.training
    return _by_label(
        partition.data,
        partition.simulator,
        fitted.names,
        evaluator.transferred_values(fitted, partition),
    )


def _by_label(
    data: Data, simulator: Simulator, mechanisms: tuple[str, ...], values: Floats
) -> dict[str, Plant]:
    own = [name for name in library() if varies_by_breath(name)]
    names = [path for path in paths(mechanisms) if path.rpartition(".")[0] not in own]
    names.remove("position")
    columns = [simulator.names.index(name) for name in names]
    result: dict[str, Plant] = {}
    for R, C in np.unique(np.stack([data.R, data.C], axis=1), axis=0):
        breath = int(np.flatnonzero((data.R == R) & (data.C == C))[0])
        with float64():
            given = dict(zip(names, values[breath, columns], strict=True))
            plant = Physics((), (), simulator.substeps, simulator.memory).having(**given)
        result[f"R{R:g}C{C:g}"] = plant
    return result
