"""Reported quantities of a conclusion: estimates, intervals, lungs, plants, unnamed effect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from ventbench.base.interval import Interval
from ventbench.diagnosis.conclusion import Conclusion, Swing, UnnamedEffect
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.findings import MissingMechanism, NonparametricTerm
from ventbench.diagnosis.hypothesis import FittedModel, Partition, varies_by_breath
from ventbench.diagnosis.in_time import ALVEOLUS, CIRCUIT, INPUT_ERROR, SUPPLY
from ventbench.diagnosis.validation import explained_share
from ventbench.mechanics.labels import FORM_ERROR, Estimate
from ventbench.physics.catalogue import (
    library,
    mechanism,
    parameter,
    paths,
    special_cases,
    strength_path,
)
from ventbench.physics.characteristics import characteristic
from ventbench.physics.nonparametric import NONPARAMETRIC_COMPONENTS, BasisTerm
from ventbench.system_id import Fit, fit, interval, profile_interval
from ventbench.system_id.data import Floats
from ventbench.system_id.predictor import START
from ventbench.system_id.problem import GIVEN
from ventbench.task.interfaces import Plant

#: Mechanisms that a periodic input is, by its place, and least weight of one that counts.
_OSCILLATIONS = {SUPPLY: "supply_ripple", CIRCUIT: "circuit_water"}
_LEAST_WEIGHT = 0.05

#: What an input is, by the place where it enters.
_INPUTS = {
    ALVEOLUS: "a pressure at the alveolus that varies in time and that no command explains",
    SUPPLY: "a flow of the supply that varies in time and that no command explains",
    CIRCUIT: "a pressure in the circuit that swings while gas flows",
}


def final_fit(fitted: FittedModel, partition: Partition, evaluator: Evaluator) -> FittedModel:
    """Fit the hypothesis of a conclusion to breaths, with its uncertain shape parameters.

    Args:
        fitted: the concluded model, fitted to some of the breaths.
        partition: breaths to fit.
        evaluator: evaluator with which the model was fitted.
    """
    hypothesis = fitted.hypothesis
    term_paths = [path for path in paths(hypothesis.names) if "." in path]
    free = [path for path in term_paths if parameter(path).uncertain]
    data, reference = partition.data, fitted.problem.data
    same = data.shares_label(reference)
    start: dict[str, Any] = {}
    for path in fitted.problem.unknowns.paths:
        if path != START and not ("." in path and varies_by_breath(path.rpartition(".")[0])):
            column = fitted.column(path)
            by_label = parameter(path).follows is not None
            start[path] = column[np.argmax(same, axis=1)] if by_label else float(np.median(column))
    if hypothesis.breath_terms:  # the efforts of each breath start where they are likeliest
        nearest = evaluator.fit(
            hypothesis, fitted.noise, start=start, partition=partition, restart=True
        )
        start |= {path: nearest.column(path) for path in nearest.problem.unknowns.paths}
    # Where rigs differ, gains that are the same in all breaths would be made up for by mechanisms.
    start.pop("gain", None)
    solution = fit(
        data,
        hypothesis.names,
        free=dict.fromkeys((*hypothesis.free, *free)),
        fixed=dict(hypothesis.fixed),
        start=start,
        gain_sd=evaluator.gain_sd,
        noise=fitted.noise,
        predictor=partition.predictor,
    )
    return FittedModel(hypothesis.names, solution.problem, solution.minimum, hypothesis)


def parameter_estimates(fitted: Fit, name: str) -> dict[str, Estimate]:
    """Estimates of a mechanism's free parameters, by short name.

    Of a parameter that differs between breaths: median and central 95 % over the breaths. Of one
    that differs between lungs: median over the lungs, and an interval that holds those of all.
    """
    values = {}
    for spec in mechanism(name).description.parameters:
        path = f"{name}.{spec.name}"
        if spec.screened:
            value, ratio = float(fitted.column(path)[0]), spec.grid[1] / spec.grid[0]
            values[spec.name] = Estimate(value, spec.unit, (value / ratio, value * ratio))
        elif path not in fitted.problem.unknowns.paths:
            continue
        elif spec.scope == "breath":
            column = fitted.column(path)
            low, middle, high = np.quantile(column, [0.025, 0.5, 0.975])
            values[spec.name] = Estimate(float(middle), spec.unit, (float(low), float(high)))
        else:
            groups = range(len(fitted.problem.unknowns.of(path)))
            ends = [_interval(fitted, path, group) for group in groups]
            low, high = min(end.low for end in ends), max(end.high for end in ends)
            middle = float(np.median([end.value for end in ends]))
            values[spec.name] = Estimate(middle, spec.unit, (low, high))
    return values


def with_form_error(
    estimates: Mapping[str, Estimate], name: str, *, alone: bool = True
) -> dict[str, Estimate]:
    """Estimates whose intervals also contain what the library's equations miss.

    Noise and scatter between breaths alone would give a lag to 0.5 % in a long recording, and no
    form of a lag is right to 0.5 %. Parameters that differ between breaths keep their intervals,
    which are those of the breaths.

    Args:
        estimates: estimates of a mechanism's parameters, by short name.
        name: name of the mechanism.
        alone: False if the mechanism acts beside others, whose forms shift its parameters too.
    """
    widened, description = {}, mechanism(name).description
    share = np.hypot(FORM_ERROR, 0.0 if alone else description.beside_error)
    for spec in description.parameters:
        if spec.name not in estimates:
            continue
        estimate = estimates[spec.name]
        if spec.scope != "breath" and not spec.change_point:
            # A time that is written as 1 s when it does not matter is not off there.
            off = spec.neutral if spec is description.strength else 0.0
            estimate = estimate.with_error(share, off, spec.low, spec.high)
        widened[spec.name] = estimate
    return widened


#: Intervals that are kept: whether a strength is definite asks for them, then the report.
_INTERVALS = 64


@lru_cache(maxsize=_INTERVALS)
def _interval(fitted: Fit, path: str, group: int) -> Interval:
    """Interval of a parameter; where it reaches the neutral value, that of the profile likelihood.

    A strength and a time of relaxation make up for each other, so that a parabola says little of
    either near the bounds.
    """
    ends = interval(fitted, path, group)
    owner, _, short = path.rpartition(".")
    spec = parameter(path)
    # The sum of two lags in series is known where their difference is not.
    exchanged = any(short in pair for pair in mechanism(owner).description.interchangeable)
    unclear = path == strength_path(owner) or exchanged
    if not unclear or spec.kinked or not ends.low <= spec.neutral <= ends.high:
        return ends
    return Interval(ends.value, *profile_interval(fitted, path, group))


def plants_of(fitted: FittedModel, evaluator: Evaluator) -> dict[str, Plant]:
    """The plant of each lung, by label; it answers as :meth:`Evaluator.predict` does.

    What changes in the course of the recording is as it is at its end: a simulator is used for
    breaths to come. The parameter ``position`` (0 first breath, 1 last) then says so.

    Args:
        fitted: the model, fitted to any breaths of the lungs.
        evaluator: evaluator with which it was fitted.
    """
    data, predictor = evaluator.training.data, evaluator.training.predictor
    values = evaluator.transferred_values(fitted, evaluator.training)
    breathwise = [name for name in library() if varies_by_breath(name)]
    names = [path for path in paths(fitted.names) if path.rpartition(".")[0] not in breathwise]
    names = [path for path in names if path not in GIVEN]
    columns = [predictor.names.index(name) for name in names]
    result: dict[str, Plant] = {}
    for breath in np.unique(data.lung, return_index=True)[1]:
        parameters = dict(zip(names, values[breath, columns], strict=True))
        if any(mechanism(name).uses_position for name in fitted.names):
            parameters["position"] = 1.0
        result[f"R{data.R[breath]:g}C{data.C[breath]:g}"] = predictor.plant(parameters)
    return result


def nonparametric_term(conclusion: Conclusion) -> NonparametricTerm | None:
    """Describe the nonparametric term of a conclusion; None if there is none."""
    place = conclusion.unnamed
    if place is None:
        return None
    explains = _share(conclusion)
    if place.swing is not None:
        return _input(place, place.swing, explains)
    assert place.term is not None
    x, y, x_unit, y_unit = _curve(conclusion.full, place.term)
    meaning = NONPARAMETRIC_COMPONENTS[place.name].meaning
    return NonparametricTerm(
        place.name, meaning, explains, place.nats, x, x_unit, y, y_unit, places=place.places
    )


def oscillation(
    conclusion: Conclusion, errors: tuple[float, float] = (0.0, 0.0)
) -> MissingMechanism | None:
    """The mechanism that a periodic input is; None if there is none, or no name for it.

    Args:
        conclusion: has the input.
        errors: error beside it, and what is shown to be no noise of that, cmH2O.
    """
    effect = conclusion.unnamed
    source = None if effect is None else effect.swing
    if effect is None or source is None:
        return None
    names = [_OSCILLATIONS.get(place) for place, weight in effect.places if weight >= _LEAST_WEIGHT]
    if _OSCILLATIONS.get(effect.name) is None or None in names:
        return None
    name, rivals = _OSCILLATIONS[effect.name], [rival for rival in names if rival is not None]
    sizes = np.sqrt(2.0 * np.mean(source.course**2, axis=1))  # amplitude of each breath
    amplitude, wide = float(sizes.mean()), 1.96 * float(sizes.std()) / len(sizes) ** 0.5
    frequency, sd = source.frequency, 1.96 * source.frequency_sd
    unit = mechanism(name).description.strength.unit
    size = Estimate(amplitude, unit, (amplitude - wide, amplitude + wide))
    return MissingMechanism(
        name,
        {
            "amplitude": size.with_error(INPUT_ERROR),
            "frequency": Estimate(frequency, "Hz", (frequency - sd, frequency + sd)),
        },
        effect.probability,
        tuple(rival for rival in rivals if rival != name),
        effect.nats,
        worth=effect.worth,
        explains=explained_share(effect.worth, *errors),
    )


def split_form(
    term: NonparametricTerm | None, names: tuple[str, ...]
) -> tuple[NonparametricTerm | None, NonparametricTerm | None]:
    """Tell whether a nonparametric term is a missing mechanism's form, or a further effect.

    A curve of the valve in any form contains the library's curve of the valve. Beside that name,
    the term does not say that something else acts: it says how the curve runs.

    Args:
        term: the term, or None.
        names: missing mechanisms.

    Returns:
        The term as the form of some of the mechanisms, and as a further effect; at most one of
        them is not None.
    """
    component = None if term is None else NONPARAMETRIC_COMPONENTS.get(term.name)
    if term is None or component is None:
        return None, term
    contained = {name for basis in component.terms for name in special_cases(basis)}
    form_of = tuple(name for name in names if name in contained)
    return (replace(term, form_of=form_of), None) if form_of else (None, term)


def _share(conclusion: Conclusion) -> float:
    """Share of the squared error above the noise that the term explains, 0..1."""
    named = conclusion.named
    weight = named.problem.data.weight
    before = float(np.sum(named.residual**2) / weight.sum())
    floor = float(conclusion.noise.sigma[0] ** 2)
    if conclusion.unnamed is not None and conclusion.unnamed.swing is not None:
        after = floor
    else:
        after = float(np.sum(conclusion.full.residual**2) / weight.sum())
    return float(np.clip((before - after) / max(before - min(floor, after), 1e-9), 0.0, 1.0))


def _input(place: UnnamedEffect, source: Swing, explains: float) -> NonparametricTerm:
    size = np.sqrt(np.mean(source.course**2, axis=1))
    course = source.course[int(np.argmax(size))]
    unit = "share of the flow, 1" if place.name == SUPPLY else "pressure, cmH2O"
    meaning = f"{_INPUTS[place.name]}, {source.frequency:.1f} times a second"
    x = np.arange(len(course), dtype=float)
    return NonparametricTerm(
        place.name,
        meaning,
        explains,
        place.nats,
        x,
        "sample of the breath where it is largest",
        course,
        unit,
        places=place.places,
    )


def _curve(full: FittedModel, element: str) -> tuple[Floats, Floats, str, str]:
    """What a basis term adds to a quantity, less what base parameters could add as well."""
    term = mechanism(element)
    paths = {p.name: f"{element}.{p.name}" for p in term.description.parameters}
    paths |= {name: name for name in ("R", "C", "gain", "R_ex", "PEEP")}
    values = {name: float(np.median(full.column(path))) for name, path in paths.items()}
    curve = characteristic(element, values)
    if curve is None:  # it acts beyond what is drawn
        return np.linspace(0.0, 1.0, 2), np.zeros(2), "share of the range", "no change"
    added = curve.acting - curve.baseline
    assert isinstance(term, BasisTerm)
    if term.absorbed:
        powers = np.stack([curve.x**power for power in term.absorbed], axis=1)
        added = added - powers @ np.linalg.lstsq(powers, added, rcond=None)[0]
    return curve.x, added, curve.x_label, f"extra {curve.y_label}"
