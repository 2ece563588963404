"""When samples are taken, and the steps between them, with edges of delayed commands on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ventbench.validation.challenge.valve import Floats

#: Means of the sampling interval that a breath may have, s.
INTERVALS = (0.0319, 0.0340)

#: Steps of the integration between two samples: about half a millisecond each, with half steps.
STEPS = 64

#: The same where gas has mass, which answers within milliseconds.
FINE = 160

#: Shortest step, s.
_GAP = 1e-6


@dataclass(frozen=True)
class Clock:
    """Steps of all breaths.

    Attributes:
        nodes: ends of the steps, s, ``(n, steps + 1)``.
        command: which command the valve follows in a step, -1 before the first, ``(n, steps)``.
        opened: 1 in the steps with an open expiratory valve, ``(n, steps)``.
    """

    nodes: Floats
    command: NDArray[np.int64]
    opened: Floats


def sampling(n: int, samples: int, jitter: float, rng: np.random.Generator) -> Floats:
    """Draw sampling times, s, ``(n, samples)``: an interval for each breath, with jitter."""
    mean = rng.choice(np.array(INTERVALS), n)[:, None]
    dt = np.clip(mean + jitter * rng.standard_normal((n, samples - 1)), 0.5 * mean, 1.5 * mean)
    time = np.concatenate([np.zeros((n, 1)), np.cumsum(dt, axis=1)], axis=1)
    return np.round(time, 6)


def clock(time: Floats, u_out: NDArray[np.int8], late: float, late_out: float, steps: int) -> Clock:
    """Lay out the steps.

    Args:
        time: of the samples, s, ``(n, T)``.
        u_out: command of the expiratory valve, ``(n, T)``.
        late: dead time of the inspiratory valve, s.
        late_out: dead time of the expiratory valve's opening, s.
        steps: between two samples.
    """
    n = len(time)
    share = np.arange(steps) / steps
    inner = time[:, :-1, None] + share * np.diff(time, axis=1)[:, :, None]
    nodes = np.concatenate([inner.reshape(n, -1), time[:, -1:]], axis=1)
    command = np.empty((n, nodes.shape[1] - 1), np.int64)
    opened = np.empty(command.shape)
    for i in range(n):
        delays = np.array([d for d in (late, late_out) if d])
        _snap(nodes[i], np.sort((time[i] + delays[:, None]).ravel()), steps)
        middle = 0.5 * (nodes[i, 1:] + nodes[i, :-1])
        command[i] = np.searchsorted(time[i] + late, middle) - 1
        now = np.searchsorted(time[i], middle) - 1
        then = np.searchsorted(time[i] + late_out, middle) - 1
        opened[i] = u_out[i, now] & np.where(then < 0, 0, u_out[i, then])
    return Clock(nodes, command, opened)


def _snap(nodes: Floats, edges: Floats, steps: int) -> None:
    """Move an end of a step onto each edge, in order; the samples stay where they are."""
    free = 1
    for edge in edges[edges < nodes[-1] - 1e-5]:
        above = int(np.searchsorted(nodes, edge))
        nearest = above - 1 if edge - nodes[above - 1] < nodes[above] - edge else above
        if nearest % steps == 0:
            nearest += 1 if edge >= nodes[nearest] else -1
        nearest = max(nearest, free)
        nearest += nearest % steps == 0  # pushed on by the edge before
        if nearest >= len(nodes) - 1:
            break  # no step is left before the last sample
        nodes[nearest] = np.clip(edge, nodes[nearest - 1] + _GAP, nodes[nearest + 1] - _GAP)
        free = nearest + 1
