"""Every PID of the paper's grid on every lung and PIP, without noise.

Without noise each breath of a run is the same, as each begins at rest and the PID starts anew, so
one inspiration stands for all.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from ventbench import environment as env
from ventbench import protocol
from ventbench.controllers.pid import PID
from ventbench.interfaces import Plant
from ventbench.scenario import Scenario, nominal

#: The paper's twenty values of P, I and D, %/cmH2O.
VALUES = (*(round(0.1 * i, 1) for i in range(10)), *(float(i) for i in range(1, 11)))

#: Gains that are run together.
BATCH = 2000


def gains() -> NDArray[np.float64]:
    """All combinations of :data:`VALUES`, P slowest, D fastest, shape ``(8000, 3)``."""
    return np.array(list(itertools.product(VALUES, VALUES, VALUES)))


@jax.jit
def _errors(plant: Plant, gains: Array, cells: Scenario) -> Array:
    cells = jax.tree.map(
        lambda x: jnp.broadcast_to(jnp.asarray(x, gains.dtype), (len(gains), *jnp.shape(x))), cells
    )
    controller = PID(gains[:, :1], gains[:, 1:2], gains[:, 2:])
    varied = env.vary(plant, cells)

    def step(carry: tuple[env.Bench, Any, Array], index: Array) -> tuple[Any, None]:
        bench, state, total = carry
        total = total + jnp.abs(bench.pressure - cells.pip)
        state, requested = controller.step(state, env.observe(cells, bench, 0, index))
        bench, _ = env.inspire(varied, cells, bench, requested)
        return (bench, state, total), None

    start = env.start_breath(varied, cells)
    carry = (start, controller.init(start.pressure.shape), jnp.zeros_like(start.pressure))
    (_, _, total), _ = jax.lax.scan(step, carry, jnp.arange(protocol.INSPIRATION_STEPS))
    return total / protocol.INSPIRATION_STEPS


def errors(
    plants: Plant,
    gains: NDArray[np.float64],
    pips: tuple[float, ...] = protocol.PIPS,
    progress: Callable[[int], None] | None = None,
) -> NDArray[np.float32]:
    """Nominal error of each PID on each lung at each PIP.

    Args:
        plants: leaves stacked over L lungs.
        gains: P, I and D, %/cmH2O, shape ``(G, 3)``.
        pips: cmH2O, P of them.
        progress: called with the number of trajectories done.

    Returns:
        Mean ``|pressure - target|`` of an inspiration, cmH2O, shape ``(L, G, P)``; float32, which
        differs from the score by less than 1e-4.
    """
    lungs = jax.tree.leaves(plants)[0].shape[0]
    count = len(gains)
    out = np.empty((lungs, count, len(pips)), np.float32)
    cells = nominal(np.asarray(pips))
    batch = min(BATCH, count)
    for lung in range(lungs):
        plant = jax.tree.map(lambda x, lung=lung: jnp.asarray(x[lung], jnp.float32), plants)
        for first in range(0, count, batch):
            # The last batch is padded with the last gains, so that all compile once.
            index = np.minimum(np.arange(first, first + batch), count - 1)
            some = jnp.asarray(gains[index], jnp.float32)
            found = np.asarray(_errors(plant, some, cells))
            out[lung, index] = found
            if progress is not None:
                progress((lung * count + min(first + batch, count)) * len(pips))
    return out


def best(error: NDArray[np.floating]) -> int:
    """Index of the PID with the lowest mean over lungs and PIPs; ``error`` as of :func:`errors`."""
    return int(np.argmin(error.mean(axis=(0, 2))))
