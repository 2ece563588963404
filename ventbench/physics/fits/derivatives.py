"""The one compiled function of all fits: pressures, and their derivatives along directions.

Every parameter of every mechanism is an input, at its neutral value where a hypothesis leaves it
out, and a hypothesis only chooses directions: one compilation for all of them. Derivatives are
differences: of few directions they take half the time and a quarter of the compilation of exact
ones, and where a parameter stands at its lower bound they look the only way that it can go.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.fits.data import Data, Floats
from ventbench.physics.model import Physics
from ventbench.physics.times import resolution
from ventbench.precision import float64

#: Name of what is not a parameter of a plant: the reading that a breath starts from, cmH2O.
START = "start"

#: Numbers of breaths that are compiled for, unless told otherwise; more are done in parts.
SIZES = (4, 8, 16, 32, 64)

#: Numbers of directions that are compiled for; more are done in parts.
_WIDTHS = (1, 2, 4, 6, 8, 12, 16)

#: How far apart values are for a difference, as a share of them or, if they are small, of 1.
_APART = 1e-6


@partial(jax.jit, static_argnames=("names", "substeps", "memory", "flow"))
def _predict(
    values: Array, commands: tuple[Array, Array, Array], names: tuple[str, ...], substeps: int,
    memory: int, flow: bool,
) -> Array:  # fmt: skip
    plant = Physics(tuple(values.T[:-1]), names, substeps, memory)

    def step(state: object, command: tuple[Array, Array, Array]) -> tuple[object, Array]:
        state, (pressure, flow_in, _) = plant.observe(state, *command)  # type: ignore[arg-type]
        return state, jnp.stack([pressure, flow_in] if flow else [pressure])

    start = values[:, -1]
    held = jax.tree.map(lambda x: jnp.moveaxis(x[:, :-1], 1, 0), commands)
    _, seen = jax.lax.scan(step, plant.init(start), held)
    first = jnp.stack([start, 0.0 * start] if flow else [start])
    return jnp.moveaxis(jnp.concatenate([first[None], seen]), (0, 1, 2), (2, 1, 0))


class Simulator:
    """All breaths of some data at once, at any parameters; compiled once for each size.

    Attributes:
        names: paths of the parameters, the columns of ``values``; the last column is the start.
        substeps: of a sample.
        memory: samples that dead times can reach back over.
    """

    def __init__(
        self,
        data: Data,
        names: tuple[str, ...],
        substeps: int | None = None,
        sizes: tuple[int, ...] = SIZES,
    ) -> None:
        """Pad and place the data.

        Args:
            data: to simulate.
            names: paths of the parameters in the order of the columns.
            substeps: of a sample; enough for most purposes if not given. An edge that a dead time
                shifts is smoothed over one substep, and the dead time is uncertain by part of it.
            sizes: to which the number of breaths is padded, each compiled once; more than the last
                are done in parts of it.
        """
        self.names = names
        self._count = len(data)
        self._part = next((size for size in sizes if size >= len(data)), sizes[-1])
        parts = max(-(-len(data) // self._part), 1)
        padded = data.padded(parts * self._part)
        enough, memory = resolution(float(np.median(data.dt)))
        self.substeps, self.memory = substeps or enough, memory
        flow = data.seen.shape[1] > 1
        self._static = {
            "names": names, "substeps": self.substeps, "memory": memory, "flow": flow
        }  # fmt: skip
        self._commands = [
            tuple(x[i * self._part : (i + 1) * self._part]
                  for x in (padded.u_in, padded.u_out, padded.dt))
            for i in range(parts)
        ]  # fmt: skip

    def predict(self, values: Floats) -> Floats:
        """What would be measured, ``(n, c, T)``, at physical values ``(n, P + 1)``."""
        return self._seen(values[None])[0]

    def derivatives(self, values: Floats, columns: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Also its derivatives with respect to k columns of ``values``, ``(n, k, c, T)``."""
        most = _WIDTHS[-1]
        if len(columns) > most:
            seen, first = self.derivatives(values, columns[:most])
            return seen, np.concatenate(
                [first, self.derivatives(values, columns[most:])[1]], axis=1
            )
        width = next(width for width in _WIDTHS if width >= len(columns))
        moved = np.repeat(values[None], 1 + width, axis=0)
        for row, column in enumerate(columns, 1):
            moved[row, :, column] += _APART * np.maximum(np.abs(values[:, column]), 1.0)
        seen, *others = self._seen(moved)
        by = [(moved[row] - values)[:, column, None, None] for row, column in enumerate(columns, 1)]
        slopes = [(other - seen) / step for other, step in zip(others, by, strict=False)]
        return seen, np.stack(slopes, axis=1)

    def _seen(self, values: Floats) -> Floats:
        """Predictions, ``(m, n, c, T)``, at each of m sets of values, ``(m, n, P + 1)``."""
        many, seen = len(values), []
        extra = len(self._commands) * self._part - self._count
        filled = np.concatenate([values, np.repeat(values[:, :1], extra, axis=1)], axis=1)
        with float64():
            for i, commands in enumerate(self._commands):
                part = filled[:, i * self._part : (i + 1) * self._part]
                flat = part.reshape(-1, part.shape[-1])
                held = tuple(jnp.asarray(np.tile(x, (many, 1))) for x in commands)
                found = np.asarray(_predict(jnp.asarray(flat), held, **self._static))
                seen.append(found.reshape(many, self._part, *found.shape[1:]))
        return np.concatenate(seen, axis=1)[:, : self._count]
