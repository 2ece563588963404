"""The one compiled function of all fits: pressures, and their derivatives along directions.

Every parameter of every mechanism is an input, at its neutral value where a hypothesis leaves it
out, and a hypothesis only chooses directions: one compilation for all of them.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.fits.data import Data, Floats
from ventbench.physics.fits.together import each
from ventbench.physics.model import Physics
from ventbench.physics.times import resolution
from ventbench.precision import float64

#: Name of what is not a parameter of a plant: the reading that a breath starts from, cmH2O.
START = "start"

#: Numbers of breaths that are compiled for, unless told otherwise; more are done in parts.
SIZES = (4, 8, 16, 32, 64)

#: Numbers of directions that are compiled for; more are done in parts.
_WIDTHS = (8, 16)

#: Directions up to which differences are faster, a fifth of the time for one; how far apart.
_FEW, _APART = 2, 1e-5

_STATIC = ("names", "substeps", "memory", "flow")

#: Both valves, %, 0/1, and the time for which they are held, s, each ``(n, T)``.
Commands = tuple[Array, Array, Array]


def _run(
    values: Array, commands: Commands, names: tuple[str, ...], substeps: int,
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


@partial(jax.jit, static_argnames=_STATIC)
def _predict(values: Array, commands: Commands, **static: object) -> Array:
    return _run(values, commands, **static)  # type: ignore[arg-type]


@partial(jax.jit, static_argnames=_STATIC)
def _along(
    values: Array, basis: Array, commands: Commands, **static: object
) -> tuple[Array, Array]:
    def run(values: Array) -> Array:
        return _run(values, commands, **static)  # type: ignore[arg-type]

    def slope(direction: Array) -> Array:
        return jax.jvp(run, (values,), (jnp.broadcast_to(direction, values.shape),))[1]

    return run(values), jax.vmap(slope)(basis)


class Simulator:
    """All breaths of some data, at any parameters; compiled once for each size.

    Parts of equally many breaths run side by side; see :func:`~.together.each`.

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
        with float64():
            u_in, u_out, dt = (
                [jnp.asarray(part) for part in np.split(x, parts)]
                for x in (padded.u_in, padded.u_out, padded.dt)
            )
        self._commands: list[Commands] = list(zip(u_in, u_out, dt, strict=True))

    def predict(self, values: Floats) -> Floats:
        """What would be measured, ``(n, c, T)``, at physical values ``(n, P + 1)``."""

        def predicted(place: tuple[Array, Commands]) -> Floats:
            with float64():
                return np.asarray(_predict(*place, **self._static))

        return np.concatenate(each(predicted, self._parts(values)))[: self._count]

    def derivatives(self, values: Floats, columns: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Also its derivatives with respect to k columns of ``values``, ``(n, k, c, T)``."""
        if len(columns) <= _FEW:
            return self._differences(values, columns)
        most = _WIDTHS[-1]
        if len(columns) > most:
            seen, first = self.derivatives(values, columns[:most])
            return seen, np.concatenate(
                [first, self.derivatives(values, columns[most:])[1]], axis=1
            )
        width = next(width for width in _WIDTHS if width >= len(columns))
        basis = np.zeros((width, len(self.names) + 1))
        basis[np.arange(len(columns)), list(columns)] = 1.0

        def followed(place: tuple[Array, Commands]) -> tuple[Floats, Floats]:
            part, commands = place
            with float64():
                here, along = _along(part, jnp.asarray(basis), commands, **self._static)
            return np.asarray(here), np.moveaxis(np.asarray(along), 0, 1)[:, : len(columns)]

        seen, slopes = zip(*each(followed, self._parts(values)), strict=True)
        return np.concatenate(seen)[: self._count], np.concatenate(slopes)[: self._count]

    def _differences(self, values: Floats, columns: tuple[int, ...]) -> tuple[Floats, Floats]:
        """The same by differences of predictions."""
        seen, slopes = self.predict(values), []
        for column in columns:
            moved = values.copy()
            moved[:, column] += _APART * np.maximum(np.abs(values[:, column]), 1.0)
            by = (moved - values)[:, column, None, None]
            slopes.append((self.predict(moved) - seen) / by)
        return seen, np.stack(slopes, axis=1)

    def _parts(self, values: Floats) -> list[tuple[Array, Commands]]:
        """Values of equally many breaths, with their commands; the last ones are made up."""
        extra = len(self._commands) * self._part - self._count
        filled = np.concatenate([values, np.repeat(values[:1], extra, axis=0)])
        with float64():
            parts = [jnp.asarray(x) for x in np.split(filled, len(self._commands))]
        return list(zip(parts, self._commands, strict=True))
