"""A second optimiser for the best attainable error, to check the first one on some cells.

It shares the pressures with :mod:`ventbench.headroom.attainable` and nothing else: Adam on commands
behind a sigmoid, from starts of its own, half of them random.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from numpy.typing import NDArray

from ventbench import precision, protocol
from ventbench.environment import Scenario
from ventbench.headroom.attainable import COMMANDS, all_pressures
from ventbench.interfaces import Plant
from ventbench.seasons import DEVELOPMENT_SEED, uniforms

#: Random starts, and starts that open the valve for some steps.
RANDOM, OPENED = 4, (1, 3, 9, 20)

#: Iterations of Adam of each start, and its first rate, which falls to zero as a cosine.
ITERATIONS, RATE = 1500, 0.12


def second_optimum(plants: Plant, cells: Scenario, *, iterations: int = ITERATIONS) -> NDArray:
    """Least error that Adam finds in cells.

    Args:
        plants: leaves ``(n, ...)``.
        cells: batch shape ``(n,)``; their noise is not used.
        iterations: of each start.

    Returns:
        Mean of ``|p - PIP|`` over steps 2 to 34, cmH2O, shape ``(n,)``.
    """
    n = np.shape(cells.pip)[0]
    cells = cells.replace(noise=np.zeros((n, 1, 1)))  # type: ignore[attr-defined]
    steps = np.arange(COMMANDS)
    starts = [np.where(steps < opened, 2.5, -2.4) for opened in OPENED]
    starts += list(6.0 * uniforms(DEVELOPMENT_SEED, "second optimum", (RANDOM, COMMANDS)) - 3.0)
    best = np.full(n, np.inf)
    with precision.float64():
        plants, cells = jax.tree.map(jnp.asarray, (plants, cells))
        for start in starts:
            free = jnp.broadcast_to(jnp.asarray(start), (n, COMMANDS))
            best = np.minimum(best, np.asarray(_search(plants, cells, free, iterations)))
    return best


def _errors(plants: Plant, cells: Scenario, free: Array) -> Array:
    pressure = all_pressures(plants, cells, protocol.U_MAX * jax.nn.sigmoid(free))
    return jnp.mean(jnp.abs(pressure - cells.pip[:, None]), axis=-1)


@partial(jax.jit, static_argnames="iterations")
def _search(plants: Plant, cells: Scenario, start: Array, iterations: int) -> Array:
    optimiser = optax.adam(optax.cosine_decay_schedule(RATE, iterations))
    gradient = jax.grad(lambda free: _errors(plants, cells, free).sum())

    def iterate(carry: tuple[Array, Any, Array], _: None) -> tuple[tuple[Array, Any, Array], None]:
        free, state, best = carry
        updates, state = optimiser.update(jnp.nan_to_num(gradient(free)), state)
        free = jnp.asarray(optax.apply_updates(free, updates))
        return (free, state, jnp.minimum(best, _errors(plants, cells, free))), None

    begun = (start, optimiser.init(start), _errors(plants, cells, start))
    (_, _, best), _ = jax.lax.scan(iterate, begun, length=iterations)
    return best
