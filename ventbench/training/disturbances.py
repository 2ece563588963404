"""What is added to a safe PID's command to explore (paper, section 4.2 and its table).

*Boundary*: from the start of the breath, falling linearly to zero. *Triangular*: from zero at a
first time up, linearly, and back to zero at a second one. Where the paper's text ends at "t_min",
t_max is meant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Range = tuple[float, float]


@dataclass(frozen=True)
class Ranges:
    """How one lung is explored.

    Attributes:
        gains: P, I, D of the PID, %/cmH2O.
        boundary_u: what is added at the start of a breath, %.
        boundary_s: how long it takes to fall to zero, s.
        triangular_u: the largest of what is added, %.
        triangular_s: where its two ends lie, s.
        boundary_share: of breaths with the boundary disturbance.
    """

    gains: tuple[float, float, float]
    boundary_u: Range
    boundary_s: Range
    triangular_u: Range
    triangular_s: Range = (0.1, 0.5)
    boundary_share: float = 0.25


#: The paper's table.
RANGES = {
    "R5C10": Ranges((1.0, 0.5, 0.0), (50.0, 100.0), (0.3, 0.6), (-20.0, 40.0)),
    "R5C20": Ranges((1.0, 3.0, 0.0), (50.0, 100.0), (0.4, 0.8), (-20.0, 60.0)),
    "R5C50": Ranges((2.0, 4.0, 0.0), (75.0, 100.0), (1.0, 1.5), (-20.0, 60.0)),
    "R20C10": Ranges((1.0, 0.5, 0.0), (50.0, 100.0), (0.3, 0.6), (-20.0, 40.0)),
    "R20C20": Ranges((0.0, 3.0, 0.0), (30.0, 60.0), (0.5, 1.0), (-20.0, 40.0)),
    "R20C50": Ranges((0.0, 4.0, 0.0), (70.0, 100.0), (1.0, 1.5), (-20.0, 40.0)),
}


@dataclass(frozen=True, eq=False)
class Disturbance:
    """One a breath; every array has shape ``(n,)``.

    Attributes:
        boundary: of which kind.
        u: the largest of what is added, %.
        begin: where it begins, s; 0 for a boundary.
        end: where it ends, s.
    """

    boundary: NDArray[np.bool_]
    u: Floats
    begin: Floats
    end: Floats

    def at(self, time: float) -> Floats:
        """What is added to the PID's command, %, ``(n,)``."""
        width = self.end - self.begin
        falling = (self.end - time) / width
        rising = (time - self.begin) / width
        tent = 2.0 * np.minimum(rising, falling)
        return self.u * np.clip(np.where(self.boundary, falling, tent), 0.0, 1.0)


def draw(random: np.random.Generator, ranges: Ranges, n: int) -> Disturbance:
    """Draw disturbances; the ends of a triangular one are two times drawn from its range."""
    boundary = random.random(n) < ranges.boundary_share
    u = np.where(
        boundary, random.uniform(*ranges.boundary_u, n), random.uniform(*ranges.triangular_u, n)
    )
    ends = np.sort(random.uniform(*ranges.triangular_s, (n, 2)), axis=1)
    ends[:, 1] = np.maximum(ends[:, 1], ends[:, 0] + 1e-3)  # never of no width
    fall = random.uniform(*ranges.boundary_s, n)
    return Disturbance(
        boundary, u, np.where(boundary, 0.0, ends[:, 0]), np.where(boundary, fall, ends[:, 1])
    )
