"""Dead times on the far side of a sample.

The likelihood of a dead time is nearly flat between two samples and falls off steeply where an edge
passes one, so that a search stays on the side where it began. The other sides are looked at with
all else refitted to first order.
"""

from __future__ import annotations

import numpy as np

from ventbench.diagnosis.linear import local
from ventbench.system_id.data import Floats
from ventbench.system_id.problem import Problem
from ventbench.system_id.unknowns import described

#: Nats by which another side must be likelier.
_CLEARLY = 2.0


def leapt(problem: Problem, x: Floats) -> Floats:
    """Move each dead time to the value of its scan that is the likeliest, if it clearly is.

    Args:
        problem: of any hypothesis.
        x: its unknowns, ``(U,)``.
    """
    for path in problem.unknowns.paths:
        item = described(path)
        if item.kinked and item.scan:
            x = _elsewhere(problem, x, path)
    return x


def _elsewhere(problem: Problem, x: Floats, path: str) -> Floats:
    place = local(problem, x, np.inf)
    column = problem.simulator.names.index(path)
    best, reached = x, float(np.sum(problem.noise.loss(place.residual))) - _CLEARLY
    for value in described(path).scan:
        trial = place.values.copy()
        trial[:, column] = value
        left = place.residual + place.template(problem.simulator.predict(trial))
        loss = float(np.sum(problem.noise.loss(left)))
        if loss < reached:
            best, reached = x.copy(), loss
            best[problem.unknowns.of(path)] = described(path).coordinate(value)
    return best
