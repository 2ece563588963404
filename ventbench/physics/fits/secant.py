"""Slopes of a problem carried from point to point, so that few are computed.

What a step changed, and the slopes did not foresee, corrects them: Broyden's update (Math. Comp.
19, 1965, 577) of each breath, in units in which every unknown has the same effect.
"""

from __future__ import annotations

import numpy as np

from ventbench.physics.fits.data import Floats
from ventbench.physics.fits.problem import Problem


class Secant:
    """What a search asks of a problem, for :func:`~.least_squares.minimise`.

    Attributes:
        problem: which is searched.
    """

    def __init__(self, problem: Problem) -> None:
        """Of a problem, at no point yet."""
        self.problem = problem
        self._x = self._asked = np.empty(0)
        self._white = self._seen = self._rows = np.empty(0)

    @property
    def known(self) -> bool:
        """Whether there are slopes to carry on."""
        return self._rows.size > 0

    def cost(self, x: Floats) -> float:
        """See :meth:`Problem.cost`."""
        seen = self.problem.white(x)
        self._asked, self._seen = x.copy(), seen
        return self.problem.cost_of(seen, x)

    def normal(self, x: Floats) -> tuple[float, Floats, Floats]:
        """See :meth:`Problem.normal`."""
        self._x = x.copy()
        self._white, self._rows = self.problem.linear(x)
        return (self.problem.cost_of(self._white, x), *self._equations())

    def near(self, x: Floats) -> tuple[Floats, Floats]:
        """Gradient and Hessian with carried slopes at the point that the cost was last asked for.

        Args:
            x: that point, ``(U,)``.
        """
        if not np.array_equal(x, self._asked):
            self.cost(x)
        step = (x - self._x)[self.problem.unknowns.index]
        missed = self._seen - self._white - np.einsum("nk,nkm->nm", step, self._rows)
        scaled = step * np.sum(self._rows**2, axis=2)
        size = np.sum(scaled * step, axis=1, keepdims=True)
        scaled = np.divide(scaled, size, out=np.zeros_like(scaled), where=size > 0)
        self._rows = self._rows + scaled[:, :, None] * missed[:, None, :]
        self._white, self._x = self._seen, x.copy()
        return self._equations()

    def _equations(self) -> tuple[Floats, Floats]:
        return self.problem.equations(self._white, self._rows, self._x)
