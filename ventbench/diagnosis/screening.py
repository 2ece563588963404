"""Values of a rule on commands, of many, that explain a residual best to first order.

A valve that moves in steps answers a command by one of its positions. Another step, larger by a
hundredth, moves many commands to other positions: the likelihood has as many maxima as there are
positions, and no fit finds the right one. So all values of a grid are compared. What a rule changes
of a command is small, and changes the pressure in proportion; of each value, the product with the
residual, once both are free of what a refit absorbs, tells the log-likelihood that it gains.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from ventbench.base.compilation import float64
from ventbench.diagnosis.hypothesis import FittedModel, Partition, linearise
from ventbench.diagnosis.in_time import command_responses
from ventbench.physics.catalogue import mechanism

#: Values between the neighbours of the best of a grid that are compared with it.
_BETWEEN = 16


def screened_points(fitted: FittedModel, name: str) -> list[dict[str, float]]:
    """The likeliest value of a screened parameter for each choice of the others.

    Args:
        fitted: a model without the mechanism.
        name: a mechanism of which one parameter is screened, and others have a grid.

    Returns:
        Values of all its parameters by path, the strength at what it is when it acts.
    """
    problem, description = fitted.problem, mechanism(name).description
    strength, *secondary = description.parameters
    linear = linearise(problem, fitted.minimum.x, clip=np.inf)
    u_in = problem.data.u_in
    responses = command_responses(Partition(problem.data, problem.predictor), linear.values)
    screened = next(p for p in secondary if p.screened)
    others = [p for p in secondary if not p.screened]
    points = []
    for choice in product(*(p.grid or (p.neutral,) for p in others)):
        chosen = {strength.name: strength.strong}
        chosen |= dict(zip((p.name for p in others), choice, strict=True))
        grid = np.array(screened.grid)
        for _ in range(2):  # then between its neighbours, if that is better
            with float64():
                values = {key: np.asarray(value) for key, value in chosen.items()}
                values[screened.name] = grid[:, None]
                driven = mechanism(name).driven(values, u_in[:, None])  # type: ignore[arg-type]
            changes = np.matmul(np.asarray(driven) - u_in[:, None], responses)  # (n, g, T)
            white = linear.project_out_breath(linear.whiten(changes[:, :, None]))
            white = linear.project_out_shared(white)
            gained = np.maximum(-np.einsum("ngm,nm->g", white, linear.residual), 0.0)
            power = np.einsum("ngm,ngm->g", white, white)
            best = int(np.argmax(gained**2 / np.maximum(power, 1e-12)))
            chosen[screened.name] = float(grid[best])
            ends = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
            grid = np.append(grid[best], np.linspace(*ends, _BETWEEN))
        points.append({f"{name}.{key}": value for key, value in chosen.items()})
    return points
