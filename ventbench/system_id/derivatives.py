"""The one compiled function of all fits: pressures, and their derivatives by differences.

Every parameter of every mechanism is an input, at its neutral value where a hypothesis leaves it
out, and a hypothesis only chooses directions: one compilation for all of them.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ventbench.physics.catalogue import parameter
from ventbench.physics.dead_time import resolution
from ventbench.physics.model import Physics
from ventbench.precision import float64
from ventbench.system_id.data import Data, Floats
from ventbench.system_id.together import each

#: Name of what is not a parameter of a plant: the reading that a breath starts from, cmH2O.
START = "start"

#: Numbers of breaths that are compiled for, unless told otherwise; more are done in parts.
SIZES = (4, 8, 16, 32, 64)

#: Numbers of points that are compiled for, at once for all breaths; more are done in parts.
_WIDTHS = (1, 4, 8)

#: Distance of two points, as a share of a parameter's range or, on a log scale, of its value: what
#: rounding and the slope's change add to a slope are about equal there.
_APART, _APART_LOG = 2e-8, 5e-8

#: Distance of two starts, cmH2O.
_APART_START = 1e-6

#: Distance of a dead time from none, s. The first tiny one moves one of the integrator's cuts to
#: its edge: what is left of that error, up to 0.03 cmH2O, must not make a slope.
_APART_LATE = 1e-3

_STATIC = ("names", "substeps", "memory", "flow", "skip_idle")

#: Both valves, %, 0/1, and the time for which they are held, s, each ``(n, T)``.
Commands = tuple[Array, Array, Array]


def _run(
    values: Array, commands: Commands, names: tuple[str, ...], substeps: int,
    memory: int, flow: bool, skip_idle: bool,
) -> Array:  # fmt: skip
    plant = Physics(
        tuple(jnp.moveaxis(values[..., :-1], -1, 0)), names, substeps, memory, skip_idle
    )

    def step(state: object, command: tuple[Array, Array, Array]) -> tuple[object, Array]:
        state, (pressure, flow_in, _) = plant.observe(state, *command)  # type: ignore[arg-type]
        return state, jnp.stack([pressure, flow_in] if flow else [pressure])

    start = values[..., -1]
    held = jax.tree.map(lambda x: jnp.moveaxis(x[:, :-1], 1, 0), commands)
    _, seen = jax.lax.scan(step, plant.init(start), held)
    first = jnp.stack([start, 0.0 * start] if flow else [start])
    return jnp.moveaxis(jnp.concatenate([first[None], seen]), (0, 1), (-1, -2))


@partial(jax.jit, static_argnames=_STATIC)
def _predict(points: Array, commands: Commands, **static: object) -> Array:
    return _run(points, commands, **static)  # type: ignore[arg-type]


class Simulator:
    """All breaths of some data, at any parameters; compiled once for each size.

    Parts of equally many breaths, and points, run side by side; see :func:`~.together.each`.

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
            "names": names, "substeps": self.substeps, "memory": memory, "flow": flow,
            "skip_idle": True,
        }  # fmt: skip
        with float64():
            u_in, u_out, dt = (
                [jnp.asarray(part) for part in np.split(x, parts)]
                for x in (padded.u_in, padded.u_out, padded.dt)
            )
        self._commands: list[Commands] = list(zip(u_in, u_out, dt, strict=True))

    def predict(self, values: Floats) -> Floats:
        """What would be measured, ``(n, c, T)``, at physical values ``(n, P + 1)``."""
        return self.predict_all(values[None])[0]

    def predict_all(self, points: Floats) -> Floats:
        """The same at several points, ``(m, n, P + 1)``, faster than one by one."""
        parts = len(self._commands)
        extra = parts * self._part - self._count  # breaths that are made up
        points = np.concatenate([points, np.repeat(points[:, :1], extra, axis=1)], axis=1)
        groups = _groups(len(points))
        work = [
            (np.resize(some, (width, *some.shape[1:])), commands)
            for first, last, width in groups
            for some, commands in zip(
                np.split(points[first:last], parts, axis=1), self._commands, strict=True
            )
        ]

        def predicted(place: tuple[Floats, Commands]) -> Floats:
            with float64():
                return np.asarray(_predict(jnp.asarray(place[0]), place[1], **self._static))

        seen = each(predicted, work)
        rows = [np.concatenate(seen[k : k + parts], axis=1) for k in range(0, len(seen), parts)]
        kept = [row[: last - first] for row, (first, last, _) in zip(rows, groups, strict=True)]
        return np.concatenate(kept)[:, : self._count]

    def derivatives(self, values: Floats, columns: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Also its derivatives with respect to k columns of ``values``, ``(n, k, c, T)``.

        By differences, since a point takes two thirds of the time of an exact derivative in one
        direction, and half to compile (``benchmarks/derivatives.py``). Pressures are continuous in
        all that is fitted; what they are not, such as the bias of a rounding, is tried value by
        value. Where an effect of either sign is off there may be a kink: it is the mean of both
        sides' slopes.
        """
        moves = np.stack([self._move(values[:, column], column) for column in columns])
        off = [k for k, column in enumerate(columns) if self._is_off(values[:, column], column)]
        points = np.repeat(values[None], 1 + len(columns) + len(off), axis=0)
        for k, column in enumerate(columns):
            points[1 + k, :, column] += moves[k]
        for point, k in zip(points[1 + len(columns) :], off, strict=True):
            point[:, columns[k]] -= moves[k]
        split = [1, 1 + len(columns)]
        seen, ahead, behind = np.split(self.predict_all(points), split)
        changes = ahead - seen
        changes[off] = 0.5 * (ahead[off] - behind)
        return seen[0], np.moveaxis(changes / moves[:, :, None, None], 0, 1)

    def _is_off(self, values: Floats, column: int) -> bool:
        """Whether a mechanism's parameter that may have either sign is where its effect is off."""
        if column == len(self.names) or "." not in self.names[column]:
            return False
        item = parameter(self.names[column])
        return item.low < item.neutral < item.high and bool(np.all(values == item.neutral))

    def _move(self, values: Floats, column: int) -> Floats:
        """To another point within the bounds, upwards if that may be, ``(n,)``."""
        if column == len(self.names):
            return np.full(len(values), _APART_START)
        item = parameter(self.names[column])
        if item.scale == "log":
            move = _APART_LOG * values
        else:
            move = np.full(len(values), _APART * (item.high - item.low))
        if item.kinked:
            move = np.where(values == item.neutral, _APART_LATE, move)
        return np.where(values + move > item.high, -move, move)


def _groups(count: int) -> list[tuple[int, int, int]]:
    """First and last of the points that are computed at once, and the number compiled for.

    A group may lack up to a quarter of that number.
    """
    groups, first = [], 0
    while first < count:
        width = max(width for width in _WIDTHS if 0.75 * width <= count - first)
        last = min(first + width, count)
        groups.append((first, last, width))
        first = last
    return groups
