"""Predicted measurements at any parameters, and their derivatives by finite differences.

One compiled function serves all hypotheses: every parameter of every mechanism is an input, which
has its neutral value where a hypothesis leaves it out.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from ventbench.executor import parallel_map
from ventbench.physics.catalogue import mechanism, parameter
from ventbench.physics.dead_time import resolution_of
from ventbench.physics.mechanism import Mechanism
from ventbench.physics.model import Physics
from ventbench.precision import float64
from ventbench.system_id.data import Data, Floats

Ints = NDArray[np.int_]

#: Path of the reading that a breath starts from, cmH2O; it is no parameter of the model.
START = "start"

#: Numbers of breaths to compile for, unless told otherwise; larger data are divided.
SIZES = (4, 8, 16, 32, 64)

#: Numbers of points to compile for, each for all breaths; a larger number is divided. A third size
#: would take as long to compile as a diagnosis takes.
_WIDTHS = (1, 8)

#: Least share of the points of a compiled size that must be asked for: eight points take as long as
#: three one by one.
_FILLED = 0.375

#: Step of a difference quotient, as a share of a parameter's range or, on a log scale, of its
#: value: rounding and truncation errors are about equal there.
_STEP, _STEP_LOG = 2e-8, 5e-8

#: Step of the starting pressure, cmH2O.
_STEP_START = 1e-6

#: Step of a dead time from zero, s. Any positive dead time moves a cut of the integrator to its
#: edge. That changes the integration error by up to 0.03 cmH2O, which must not make a slope.
_STEP_DEAD_TIME = 1e-3

#: Strength from which a mechanism counts as acting: above the step of a difference quotient from
#: zero, both ends of which must be integrated alike.
_ACTS = 1e-6

_STATIC = ("names", "substeps", "memory", "flow", "skip_idle")

#: Both valves, %, 0/1, and the time for which they are held, s, each ``(n, T)``.
Commands = tuple[Array, Array, Array]


def _run(
    values: Array, commands: Commands, divisions: Array, names: tuple[str, ...], substeps: int,
    memory: int, flow: bool, skip_idle: bool,
) -> Array:  # fmt: skip
    plant = Physics(
        tuple(jnp.moveaxis(values[..., :-1], -1, 0)), names, substeps, memory, skip_idle
    )

    def step(state: object, command: tuple[Array, Array, Array]) -> tuple[object, Array]:
        state, (pressure, flow_in, _) = plant.observe(state, *command, divisions)  # type: ignore[arg-type]
        return state, jnp.stack([pressure, flow_in] if flow else [pressure])

    start = values[..., -1]
    held = jax.tree.map(lambda x: jnp.moveaxis(x[:, :-1], 1, 0), commands)
    _, seen = jax.lax.scan(step, plant.init(start), held)
    first = jnp.stack([start, 0.0 * start] if flow else [start])
    return jnp.moveaxis(jnp.concatenate([first[None], seen]), (0, 1), (-1, -2))


@partial(jax.jit, static_argnames=_STATIC)
def _predict(points: Array, commands: Commands, divisions: Array, **static: object) -> Array:
    return _run(points, commands, divisions, **static)  # type: ignore[arg-type]


def needs_small_steps(path: str) -> bool:
    """Whether a parameter belongs to a mechanism that needs several steps in a substep."""
    owner = path.rpartition(".")[0]
    return bool(owner) and mechanism(owner).divisions > 1


class Predictor:
    """Predictions for all breaths of some data, at any parameters; compiled once for each size.

    Blocks of breaths and points are computed in parallel; see :func:`~.parallel.parallel_map`.

    Attributes:
        names: paths of the parameters in the order of the columns of ``values``, whose last column
            is the start.
        substeps: number of substeps in a sample.
        memory: number of past samples that a dead time can reach back over.
    """

    def __init__(
        self,
        data: Data,
        names: tuple[str, ...],
        substeps: int | None = None,
        sizes: tuple[int, ...] = SIZES,
    ) -> None:
        """Pad the data to a compiled size.

        Args:
            data: breaths to predict.
            names: paths of the parameters in the order of the columns.
            substeps: number of substeps in a sample; enough for most purposes if not given. An edge
                that a dead time shifts is smoothed over one substep, and the dead time is uncertain
                by part of it.
            sizes: numbers of breaths to pad to, each compiled once; data with more breaths than the
                last are divided into blocks of that size.
        """
        self.names = names
        self._count, self._large_steps = len(data), False
        self._part = next((size for size in sizes if size >= len(data)), sizes[-1])
        parts = max(-(-len(data) // self._part), 1)
        padded = data.padded(parts * self._part)
        enough, memory = resolution_of(data.dt)
        if not any(_has_dead_time(name) for name in names):
            memory = 1
        self.substeps, self.memory = substeps or enough, memory
        flow = data.measured.shape[1] > 1
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

    @property
    def with_large_steps(self) -> Predictor:
        """The same with one step of the integrator in each substep, whatever acts."""
        other = copy(self)
        other._large_steps = True
        return other

    def predict(self, values: Floats) -> Floats:
        """Predicted measurements, ``(n, c, T)``, at physical values ``(n, P + 1)``."""
        return self.predict_all(values[None])[0]

    def predict_all(self, points: Floats) -> Floats:
        """Predicted measurements, ``(m, n, c, T)``, at several points ``(m, n, P + 1)``."""
        parts = len(self._commands)
        extra = parts * self._part - self._count  # padding breaths
        points = np.concatenate([points, np.repeat(points[:, :1], extra, axis=1)], axis=1)
        divisions = self._divisions(points)
        groups = [
            (np.flatnonzero(divisions == count)[first:last], width, count)
            for count in np.unique(divisions)
            for first, last, width in _groups(int((divisions == count).sum()))
        ]
        work = [
            (np.resize(some, (width, *some.shape[1:])), commands, count)
            for where, width, count in groups
            for some, commands in zip(
                np.split(points[where], parts, axis=1), self._commands, strict=True
            )
        ]

        def predicted(place: tuple[Floats, Commands, int]) -> Floats:
            with float64():
                return np.asarray(
                    _predict(jnp.asarray(place[0]), place[1], jnp.asarray(place[2]), **self._static)
                )

        seen = parallel_map(predicted, work)
        rows = [np.concatenate(seen[k : k + parts], axis=1) for k in range(0, len(seen), parts)]
        answers = np.empty((len(points), *rows[0].shape[1:]))
        for row, (where, _, _) in zip(rows, groups, strict=True):
            answers[where] = row[: len(where)]
        return answers[:, : self._count]

    def plant(self, values: Mapping[str, ArrayLike]) -> Physics:
        """The model at values by path, as a plant in float64 that predicts what this one does."""
        acting = [_divisions_at(path, np.asarray(value)) for path, value in values.items()]
        with float64():
            plant = Physics((), (), self.substeps, self.memory, divisions=max([1, *acting]))
            return plant.having(**values)

    def derivatives(self, values: Floats, columns: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Predictions, and their derivatives with respect to k columns, ``(n, k, c, T)``.

        The derivatives are finite differences: a point takes two thirds of the time of an exact
        directional derivative, and half the time to compile (``benchmarks/derivatives.py``).
        Pressures are continuous in all free parameters; a parameter in which they are not, such as
        the bias of a rounding, is tried value by value. An effect that may have either sign can
        have a kink where it is off: there, the derivative is the mean of both one-sided slopes.
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

    def _divisions(self, points: Floats) -> Ints:
        """Steps of the integrator in a substep that each point needs, ``(m,)``."""
        if self._large_steps:
            return np.ones(len(points), int)
        needed = [
            [_divisions_at(name, point[:, k]) for k, name in enumerate(self.names)]
            for point in points
        ]
        return np.max(needed, axis=1, initial=1)

    def _is_off(self, values: Floats, column: int) -> bool:
        """Whether a parameter of a mechanism that may have either sign is at its neutral value."""
        if column == len(self.names) or "." not in self.names[column]:
            return False
        definition = parameter(self.names[column])
        return definition.low < definition.neutral < definition.high and bool(
            np.all(values == definition.neutral)
        )

    def _move(self, values: Floats, column: int) -> Floats:
        """Step to another point within the bounds, upwards if possible, ``(n,)``."""
        if column == len(self.names):
            return np.full(len(values), _STEP_START)
        definition = parameter(self.names[column])
        if definition.scale == "log":
            move = _STEP_LOG * values
        else:
            move = np.full(len(values), _STEP * (definition.high - definition.low))
        if definition.kinked:
            move = np.where(values == definition.neutral, _STEP_DEAD_TIME, move)
        return np.where(values + move > definition.high, -move, move)


def _divisions_at(path: str, values: Floats) -> int:
    """Steps of the integrator in a substep that a parameter needs at these values."""
    if not needs_small_steps(path):
        return 1
    owner, _, short = path.rpartition(".")
    strength = mechanism(owner).description.parameters[0]
    acts = short == strength.name and np.any(np.abs(values - strength.neutral) > _ACTS)
    return mechanism(owner).divisions if acts else 1


def _has_dead_time(path: str) -> bool:
    """Whether a parameter belongs to a mechanism that delays a command."""
    owner = path.rpartition(".")[0]
    if not owner:
        return False
    own = type(mechanism(owner))
    return (
        own.dead_time is not Mechanism.dead_time
        or own.outlet_dead_time is not Mechanism.outlet_dead_time
    )


def _groups(count: int) -> list[tuple[int, int, int]]:
    """First and last of the points that are computed at once, and the compiled number of points.

    A group may lack up to five of eight.
    """
    groups, first = [], 0
    while first < count:
        width = max(width for width in _WIDTHS if _FILLED * width <= count - first)
        last = min(first + width, count)
        groups.append((first, last, width))
        first = last
    return groups
