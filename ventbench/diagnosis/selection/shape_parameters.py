"""Shape parameters of a hypothesis's terms, and other starts of dead times.

An exponent, a recovery time or a second lag stays at its default unless the recording asks for
another value. Mechanisms that act alike may differ by their shape alone, so that rivals are
compared with free shapes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ventbench.base.executor import parallel_map
from ventbench.diagnosis.evaluator import Evaluator
from ventbench.diagnosis.hypothesis import FittedModel, Hypothesis, varies_by_breath
from ventbench.physics.catalogue import mechanism
from ventbench.system_id.noise import Noise
from ventbench.system_id.problem import parameter_of


def free_shape_parameters(
    evaluator: Evaluator, current: FittedModel, name: str | None = None
) -> FittedModel:
    """Free the shape parameters of a term that the recording asks for, and no others.

    Screening frees a shape that promises more than the default one. Where the fit needs no such
    freedom, the default returns.

    Args:
        evaluator: evaluator of the recording.
        current: the model.
        name: the term; the newest one if None.
    """
    name = name or current.hypothesis.names[-1]
    for about in mechanism(name).description.parameters:
        path = f"{name}.{about.name}"
        if not about.shape or about.discrete:
            continue
        if path in current.hypothesis.free:
            usual = evaluator.fit(current.hypothesis.with_default(path), current.noise, current)
            if evaluator.criterion(usual) <= evaluator.criterion(current):
                current = usual
            continue
        freer = fit_with_shape(evaluator, current, path, current.noise)
        if np.all(freer.column(path) == about.neutral):
            continue  # another start may have found a better fit, but no other shape
        if evaluator.criterion(freer) > evaluator.criterion(current):
            continue
        before = evaluator.held_out_log_likelihood(current)
        gained = float((evaluator.held_out_log_likelihood(freer) - before).sum())
        if gained > evaluator.settings.forward.shape_gain:
            current = freer
    return current


def fit_with_shape(
    evaluator: Evaluator, model: FittedModel, path: str, noise: Noise
) -> FittedModel:
    """Fit a model with a shape parameter free as well, from the best of :func:`shape_starts`."""
    name = path.rpartition(".")[0]
    freed = model.hypothesis.plus(Hypothesis((name,), (path,)))
    fits = parallel_map(
        lambda start: evaluator.fit(
            freed, noise, model, start, restart=bool(start) and varies_by_breath(name)
        ),
        shape_starts(model, path),
    )
    return min(fits, key=lambda fitted: fitted.minimum.cost)


def shape_starts(model: FittedModel, path: str) -> list[dict[str, Any]]:
    """Values that the fit of a shape parameter starts from, by path.

    A lag that was fitted alone is as long as the two that it stands for, and a dead time before it
    makes up for what is left: neither moves by itself. A parameter that can be exchanged with
    another one therefore also starts at half of it, with each dead time as it is and one sample
    off. A shape that a small change cannot reach, such as that of an effort whose onset is fitted
    to another one, starts from the values of its grid as well.
    """
    name, _, short = path.rpartition(".")
    about = parameter_of(path)
    starts: list[dict[str, Any]] = [{}, *({path: v} for v in about.grid if v != about.neutral)]
    for pair in mechanism(name).description.interchangeable:
        if short in pair:
            other = f"{name}.{pair[1 - pair.index(short)]}"
            halves = dict.fromkeys((path, other), 0.5 * model.column(other))
            starts += [halves | shift for shift in ({}, *other_dead_times(model))]
    return starts


def shapes_at_default(model: FittedModel, name: str | None = None) -> list[str]:
    """Paths of a term's continuous shape parameters that are not fitted; the newest's if None."""
    name = name or model.names[-1]
    paths = {
        f"{name}.{about.name}"
        for about in mechanism(name).description.parameters
        if about.shape and not about.discrete
    }
    fitted = {*model.hypothesis.free, *(path for path, _ in model.hypothesis.fixed)}
    return sorted(paths - fitted)


def other_dead_times(fitted: FittedModel) -> list[dict[str, float]]:
    """Values of each fitted dead time one sample before and after, by path.

    A dead time that was fitted without an effect may stand on the wrong side of a sample, where
    nothing that is added to it alone helps.
    """
    interval = float(np.median(fitted.problem.data.dt))
    others = []
    for path in fitted.hypothesis.paths:
        about = parameter_of(path)
        if about.kinked and about.scan and about.unit == "s":
            value = float(np.median(fitted.column(path)))
            near = {min(max(value + step, about.low), about.high) for step in (-interval, interval)}
            others += [{path: other} for other in sorted(near - {value})]
    return others
