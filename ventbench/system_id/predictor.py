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
import jaxlib.version
import numpy as np
from jax import Array
from numpy.typing import ArrayLike, NDArray

from ventbench.base.arrays import Floats
from ventbench.base.compilation import float64
from ventbench.base.executor import parallel_map
from ventbench.physics.catalogue import mechanism, parameter
from ventbench.physics.dead_time import resolution_of
from ventbench.physics.model import Physics
from ventbench.system_id.data import Data

Ints = NDArray[np.int_]

#: Path of the reading that a breath starts from, cmH2O; it is no parameter of the model.
START = "start"

#: A reading, cmH2O or mL/s, or its change by a unit of any parameter, that is none of a rig: a jump
#: of 3 L/s within 10 ms is 3e5 a second of delay. What exceeds it has diverged.
UNSTABLE = 1e7

#: Numbers of simulations to compile for, unless told otherwise: the least that holds all breaths,
#: or the last.
SIZES = (4, 8, 16, 32, 64)

#: Multiples of that number to compile for; more simulations are divided. A third size would take as
#: long to compile as a diagnosis takes.
_WIDTHS = (1, 8)

#: Least share of a compiled size that must be asked for: eight times as many simulations take as
#: long as three of the small size.
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

#: How XLA compiles for a processor. Loops of many small operations spend their time between these:
#: an analysis of regions saves copies of a loop's state, and the older emitters compile and run
#: faster here, by 15 % for 40 breaths.
_COMPILER = {
    "xla_cpu_copy_insertion_use_region_analysis": True,
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
}
if jaxlib.version.__version_info__ < (0, 11):  # later ones have no others
    _COMPILER["xla_cpu_use_fusion_emitters"] = False

_STATIC = ("names", "substeps", "memory", "flow", "skip_idle")

#: Both valves, %, 0/1, and the time for which they are held, s, each ``(n, T)``.
Commands = tuple[Array, Array, Array]


def _run(
    values: Array,
    commands: Commands,
    divisions: Array,
    names: tuple[str, ...],
    substeps: int,
    memory: int,
    flow: bool,
    skip_idle: bool,
) -> Array:
    plant = Physics(
        tuple(jnp.moveaxis(values[..., :-1], -1, 0)), names, substeps, memory, skip_idle
    )

    def step(state: object, command: tuple[Array, Array, Array]) -> tuple[object, Array]:
        state, signals = plant.step(state, *command, divisions)  # type: ignore[arg-type]
        return state, jnp.stack([signals.reading, signals.flow] if flow else [signals.reading])

    start = values[..., -1]
    held = jax.tree.map(lambda x: jnp.moveaxis(x[:, :-1], 1, 0), commands)
    _, samples = jax.lax.scan(step, plant.init(start)[0], held)
    first = jnp.stack([start, 0.0 * start] if flow else [start])
    return jnp.moveaxis(jnp.concatenate([first[None], samples]), (0, 1), (-1, -2))


@partial(jax.jit, static_argnames=_STATIC, compiler_options=_COMPILER)
def _predict(points: Array, commands: Commands, divisions: Array, **static: object) -> Array:
    return _run(points, commands, divisions, **static)  # type: ignore[arg-type]


def needs_small_steps(path: str) -> bool:
    """Whether a parameter belongs to a mechanism that needs several steps in a substep."""
    owner = path.rpartition(".")[0]
    return bool(owner) and mechanism(owner).divisions > 1


class Predictor:
    """Predictions for all breaths of some data, at any parameters; compiled once for each size.

    A simulation is one breath at one point. Those of all points are lined up, and computed in
    blocks of a compiled size, whatever breath or point a block begins with: few breaths at many
    points fill it as well as many breaths do. Blocks are computed in parallel; see
    :func:`~ventbench.base.executor.parallel_map`.

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
        """Choose the sizes to compile for.

        Args:
            data: breaths to predict.
            names: paths of the parameters in the order of the columns.
            substeps: number of substeps in a sample; enough for most purposes if not given. An edge
                that a dead time shifts is smoothed over one substep, and the dead time is uncertain
                by part of it.
            sizes: numbers of simulations to compile for, see :data:`SIZES`.
        """
        self.names = names
        self._large_steps = False
        self._size = next((size for size in sizes if size >= len(data)), sizes[-1])
        resolved, memory = resolution_of(data.dt)
        if not any(_has_dead_time(name) for name in names):
            memory = 1
        self.substeps, self.memory = substeps or resolved, memory
        flow = data.measured.shape[1] > 1
        self._static = {
            "names": names,
            "substeps": self.substeps,
            "memory": memory,
            "flow": flow,
            "skip_idle": True,
        }
        self._commands = (data.u_in, data.u_out, data.dt)
        self._stiff = [
            (column, *stiff) for column, name in enumerate(names) if (stiff := _small_steps(name))
        ]

    def of(self, data: Data) -> Predictor:
        """The same for other breaths, by the functions that are compiled where they suffice."""
        predictor = Predictor(data, self.names, self.substeps, (self._size,))
        predictor.memory = max(self.memory, predictor.memory)
        predictor._static["memory"] = predictor.memory
        return predictor

    @property
    def with_large_steps(self) -> Predictor:
        """The same with one step of the integrator in each substep, whatever acts."""
        predictor = copy(self)
        predictor._large_steps = True
        return predictor

    def predict(self, values: Floats) -> Floats:
        """Predicted measurements, ``(n, c, T)``, at physical values ``(n, P + 1)``."""
        return self.predict_all(values[None])[0]

    def predict_all(self, points: Floats) -> Floats:
        """Predicted measurements, ``(m, n, c, T)``, at several points ``(m, n, P + 1)``."""
        count, breaths, width = points.shape
        lanes = points.reshape(-1, width)
        divisions = np.repeat(self._divisions(points), breaths)
        work = []
        for steps in np.unique(divisions):
            same_steps = np.flatnonzero(divisions == steps)
            work += [
                (same_steps[first:last], size, int(steps))
                for first, last, size in _blocks(len(same_steps), self._size)
            ]

        def predicted(block: tuple[Ints, int, int]) -> Floats:
            where, size, steps = block
            filled = np.resize(where, size)
            breath = filled % breaths
            with float64():
                # The compiled function takes NumPy's arrays as they are; making JAX's of them first
                # took a tenth of a diagnosis.
                commands = tuple(command[breath] for command in self._commands)
                simulated = _predict(lanes[filled], commands, np.asarray(steps), **self._static)
                return np.asarray(simulated)[: len(where)]

        simulated = parallel_map(predicted, work)
        answers = np.empty((len(lanes), *simulated[0].shape[1:]))
        for rows, (where, _, _) in zip(simulated, work, strict=True):
            answers[where] = rows
        return answers.reshape(count, breaths, *answers.shape[1:])

    def plant(self, values: Mapping[str, ArrayLike]) -> Physics:
        """The model at values by path, as a plant in float64 that predicts what this one does."""
        acting = [_divisions_at(path, np.asarray(value)) for path, value in values.items()]
        with float64():
            plant = Physics((), (), self.substeps, self.memory, divisions=max([1, *acting]))
            return plant.having(**values)

    def derivatives(self, values: Floats, columns: tuple[int, ...]) -> tuple[Floats, Floats]:
        """Predictions, and their derivatives with respect to k columns, ``(n, k, c, T)``.

        The derivatives are finite differences: a point takes two thirds of the time of an exact
        directional derivative, and half the time to compile.
        Pressures are continuous in all free parameters; a parameter in which they are not, such as
        the bias of a rounding, is tried value by value. An effect that may have either sign can
        have a kink where it is off: there, the derivative is the mean of both one-sided slopes.
        It is zero where the model can simulate a breath, but not at the point beside it, or only by
        an integration that diverges.
        """
        moves = np.stack([self._move(values[:, column], column) for column in columns])
        off = [k for k, column in enumerate(columns) if self._is_off(values[:, column], column)]
        points = np.repeat(values[None], 1 + len(columns) + len(off), axis=0)
        for k, column in enumerate(columns):
            points[1 + k, :, column] += moves[k]
        for point, k in zip(points[1 + len(columns) :], off, strict=True):
            point[:, columns[k]] -= moves[k]
        split = [1, 1 + len(columns)]
        centre, ahead, behind = np.split(self.predict_all(points), split)
        changes = ahead - centre
        changes[off] = 0.5 * (ahead[off] - behind)
        slopes = changes / moves[:, :, None, None]
        slopes[~(np.abs(slopes) < UNSTABLE) & np.isfinite(centre)] = 0.0
        return centre[0], np.moveaxis(slopes, 0, 1)

    def _divisions(self, points: Floats) -> Ints:
        """Steps of the integrator in a substep that each point needs, ``(m,)``."""
        needed = np.ones(len(points), int)
        for column, neutral, divisions in () if self._large_steps else self._stiff:
            acts = np.any(np.abs(points[:, :, column] - neutral) > _ACTS, axis=1)
            needed[acts] = np.maximum(needed[acts], divisions)
        return needed

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


def _small_steps(path: str) -> tuple[float, int] | None:
    """Where a strength is neutral, and the steps of the integrator in a substep beyond; or None.

    None for all parameters of mechanisms that need no small steps, and for all but the strength.
    """
    if not needs_small_steps(path):
        return None
    owner, _, short = path.rpartition(".")
    strength = mechanism(owner).description.strength
    return (strength.neutral, mechanism(owner).divisions) if short == strength.name else None


def _divisions_at(path: str, values: Floats) -> int:
    """Steps of the integrator in a substep that a parameter needs at these values."""
    stiff = _small_steps(path)
    return stiff[1] if stiff and np.any(np.abs(values - stiff[0]) > _ACTS) else 1


def _has_dead_time(path: str) -> bool:
    """Whether a parameter belongs to a mechanism that delays a command."""
    owner = path.rpartition(".")[0]
    return bool(owner) and any(mechanism(owner).has(x) for x in ("dead_time", "outlet_dead_time"))


def _blocks(count: int, size: int) -> list[tuple[int, int, int]]:
    """First and last of the simulations that are computed at once, and the compiled number.

    A block may lack up to five eighths of a larger size than the smallest.
    """
    blocks, first = [], 0
    while first < count:
        width = size * max(w for w in _WIDTHS if w == 1 or _FILLED * w * size <= count - first)
        last = min(first + width, count)
        blocks.append((first, last, width))
        first = last
    return blocks
