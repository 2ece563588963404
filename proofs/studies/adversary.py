"""An adversary: the mildest plausible physics under which an entry is unsafe.

Coordinates of the search are a share of the strong strength of each stressor, 0 to 1, and of the
rig: orthogonal directions of its population that move the quantities :data:`RIG`, in units of
:data:`EDGE` standard deviations. The severity of a point is its distance from the origin, the rig
in the middle of the population without a stressor; severity 1 is the end of the range. A run is
unsafe by the protocol's gate, or where the controller fails.

:func:`mildest` first goes outwards along each coordinate alone, then along combinations: it changes
the direction at random, asks at the present critical severity and a little below it, and keeps the
direction that is worst. What it finds is an upper bound on the least severity; that it finds
nothing is no proof. The same margins give the same answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ventbench.base import compilation
from ventbench.base.arrays import Bools, Floats, Ints
from ventbench.base.errors import InputError
from ventbench.entries.cells import PlantError, Runner, by_breath, runner_of, step_through
from ventbench.entries.folder import Submission, as_submission
from ventbench.entries.runs import number
from ventbench.entries.scoring import enter
from ventbench.physics.catalogue import parameter
from ventbench.plants.catalog import SimulatorLike
from ventbench.plants.corrected import Stressed, stressed_plants
from ventbench.plants.hybrid import NAMES, from_vector
from ventbench.plants.rigs import Rigs, load_rigs
from ventbench.task import protocol
from ventbench.task.environment import nominal_scenario
from ventbench.task.metrics.score import safety_limit
from ventbench.task.stressors import STRESSORS, Condition, Stressor, stressor

#: Severities at which each coordinate is tried alone.
LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)

#: Rounds of the search over directions, directions of each, and the factor below the present
#: severity at which they are asked as well.
ROUNDS, DIRECTIONS, BELOW = 20, 12, 0.85

#: Share of the coordinates that change in a direction, and the first and last standard deviation of
#: the change over the largest coordinate.
CHANGED, WIDTHS = 0.3, (0.6, 0.1)

#: A coordinate smaller than this share of the largest is left out of a direction.
NEGLIGIBLE = 0.1

#: Most that a margin counts where directions are compared.
MOST = 100.0

#: Points of each lung that are run together.
BATCH = 24

#: By how much points ``(..., L, A)`` at settings ``(..., L)`` are beyond a limit, any unit: above 0
#: it goes wrong, infinite where there is no degree. Shape ``(..., L)``.
Margin = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True, eq=False)
class Space:
    """Coordinates of the search, A of them."""

    group: Ints  #: of each coordinate; at most one of a group is not zero in a point, length A.
    signed: Bools  #: whether a coordinate may be negative, length A.

    def directions(self, points: Floats) -> Floats:
        """Points of severity 1 in given directions, with the rules kept, shape ``(..., A)``."""
        points = np.where(self.signed, points, np.maximum(points, 0.0))
        size = np.abs(points)
        for own in np.unique(self.group):
            at = np.flatnonzero(self.group == own)
            size[..., at] *= size[..., at] >= size[..., at].max(axis=-1, keepdims=True)
        points = np.where(size > NEGLIGIBLE * size.max(axis=-1, keepdims=True), points, 0.0)
        return points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-15)


class Found(NamedTuple):
    """Result of :func:`mildest` for L lungs."""

    severity: Floats  #: shape ``(L,)``; NaN where nothing went wrong.
    #: the coordinates, shape ``(L, A)``; where nothing went wrong the worst of severity 1.
    point: Floats
    setting: Floats  #: of these points, shape ``(L,)``.
    margin: Floats  #: of these points, shape ``(L,)``; see :data:`Margin`.


def mildest(margin: Margin, space: Space, lungs: int, settings: Sequence[float]) -> Found:
    """Search for the mildest point of each of L lungs at which something goes wrong.

    Each point may be tried at each of some settings, such as PIPs.
    """
    axes = np.eye(len(space.group))
    axes = np.repeat(np.concatenate([axes, -axes[space.signed]])[:, None], lungs, axis=1)
    count, every = len(axes), np.arange(lungs)
    # A ray is a direction at a setting; those of one setting follow each other.
    rays = np.tile(axes, (len(settings), 1, 1))
    at = np.repeat(settings, count)[:, None].repeat(lungs, axis=1)
    values = margin(np.multiply.outer(LEVELS, rays), at)
    first = np.where(values > 0, np.reshape(LEVELS, (-1, 1, 1)), np.inf).min(axis=0)
    start, end = np.minimum(values[0], MOST), np.minimum(values[-1], MOST)

    # The mildest ray of each lung; of equal ones that which is worst at the end of the range.
    best = (np.minimum(first, 2.0) - 1e-6 * end).argmin(axis=0)
    direction, radius, setting = rays[best, every], first[best, every], at[best, every]
    # Were margins linear, the steepest ascent would be the answer.
    same = best // count * count + np.arange(count)[:, None]
    steepest = np.einsum("jla,jl->la", axes, np.maximum(end - start, 0.0)[same, every])
    numbers = np.random.default_rng(0)
    for width in np.geomspace(*WIDTHS, ROUNDS):
        # The same changes for all lungs: none depends on which others are searched.
        step = width * numbers.normal(size=(DIRECTIONS, 1, axes.shape[-1]))
        step = step * (numbers.random(step.shape) < CHANGED)
        fresh = direction + step * np.abs(direction).max(axis=-1, keepdims=True)
        fresh[0], fresh[1] = direction, steepest
        fresh = space.directions(fresh)
        now = np.minimum(radius, 1.0)
        values = margin(np.stack([BELOW * now, now])[:, None, :, None] * fresh, setting)
        below = (values[0] > 0).any(axis=0)
        ahead = np.where(below, values[0], values[1])
        direction = fresh[ahead.argmax(axis=0), every]
        radius = np.where(below, BELOW * now, np.where(ahead.max(axis=0) > 0, now, radius))

    severity, step = np.minimum(radius, 1.0), np.minimum(radius, 1.0)
    for _ in range(2):  # the first severity on the way that goes wrong, closer and closer
        asked = severity - step * np.linspace(1.0, 0.0, BATCH + 1)[1:, None]
        wrong = margin(asked[..., None] * direction, setting) > 0
        severity, step = asked[wrong.argmax(axis=0), every], step / BATCH
    point = np.where(np.isfinite(radius), severity, 1.0)[:, None] * direction
    severity = np.where(np.isfinite(radius), severity, np.nan)
    return Found(severity, point, setting, margin(point, setting))


#: Quantities of a rig that are moved.
RIG = ("resistance", "elastance", "valve_size", "valve_delay", "valve_lag", "sensor_lag")

#: Standard deviations of the population from its middle to the end of the range.
EDGE = 3.0

#: Least change of a quantity of the rig that is shown, relative.
SHOWN = 0.02

#: PIPs that are tried, cmH2O: the ends of the protocol's.
PIPS = (protocol.PIPS[0], protocol.PIPS[-1])


@dataclass(frozen=True)
class Critical:
    """The mildest unsafe physics of a lung that was found."""

    lung: str  #: id.
    severity: float | None  #: 0 to 1; None if nothing unsafe was found up to the end of the range.
    pip: float  #: cmH2O.
    #: highest pressure that was held for longer than the gate allows, less what is safe, cmH2O; of
    #: severity 1 where nothing was found; None where the controller failed.
    excess: float | None
    physics: dict[str, str]  #: what deviates, in physical units, by name of the quantity.

    def lines(self) -> list[str]:
        """Say it to a person; where nothing was found, with the worst physics of severity 1."""
        at = "nothing unsafe up to" if self.severity is None else "unsafe at"
        severity = 1 if self.severity is None else self.severity
        first = f"{self.lung}: {at} severity {severity:.3g}, PIP {self.pip:g}"
        return [first, *(f"  {name}: {value}" for name, value in self.physics.items())]


def adversary(
    submission: Any,
    *,
    simulator: SimulatorLike = "frozen",
    lungs: Sequence[str] = (),
    stressors: Sequence[str] = (),
    sandbox: bool = True,
) -> list[Critical]:
    """Search for the mildest plausible physics under which a controller is unsafe.

    Args:
        submission: see :func:`ventbench.score`; it runs on the first track that it enters.
        simulator: simulators with plants; only the frozen ones have a population of rigs.
        lungs: ids; all if empty.
        stressors: names of those that may act; all, and the rig, if empty.
        sandbox: run a folder in locked-down processes; see :func:`ventbench.score`.

    Returns:
        One result a lung, in the order of the simulators.

    Raises:
        SubmissionError: if there is no such submission, or it cannot be run.
        SandboxError: if this machine cannot run submissions apart.
        InputError: if there are no such simulators, lungs or stressors.
    """
    entry, rigs = as_submission(submission), load_rigs(simulator)
    lines = tuple(stressor(name) for name in stressors) or STRESSORS
    known = [lung.id for lung in rigs.lungs]
    for name in lungs:
        if name not in known:
            raise InputError(f"no lung {name!r} in these simulators; choose of {', '.join(known)}")
    chosen = [k for k, name in enumerate(known) if not lungs or name in lungs]
    runner = runner_of(entry, sandbox=sandbox)
    bench = _Bench(entry, runner, rigs, chosen, lines, () if stressors else RIG)
    found = mildest(bench.margin, bench.space, len(chosen), PIPS)
    return [
        Critical(
            known[lung],
            number(found.severity[k]),
            float(found.setting[k]),
            number(found.margin[k]),
            bench.physics(found.point, k),
        )
        for k, lung in enumerate(chosen)
    ]


class _Bench:
    """Runs an entry at points of the search.

    Attributes:
        space: the coordinates: stressors, then directions of the rig.
    """

    def __init__(
        self,
        entry: Submission,
        runner: Runner,
        rigs: Rigs,
        chosen: Sequence[int],
        lines: Sequence[Stressor],
        quantities: Sequence[str],
    ) -> None:
        self._entry, self._runner, self._lines = entry, runner, lines
        self._lungs = [rigs.lungs[k] for k in chosen]
        self._tasks = enter(entry, None, [lung.id for lung in self._lungs], runner)[1] * BATCH
        self._quantities = quantities if rigs.population is not None else ()
        self._has_population = rigs.population is not None
        if rigs.population is not None:
            self._mean, factor = rigs.population.mean[chosen], rigs.population.factor[chosen]
            # The likeliest rig with a quantity that is off lies along its row of the factor.
            rows = factor[:, [NAMES.index(name) for name in quantities]]
            self._moves = EDGE * factor @ np.linalg.qr(rows.swapaxes(1, 2))[0]
        else:
            self._plants = jax.tree.map(lambda leaf: np.asarray(leaf)[chosen], rigs.plants)
        strengths = [line.strength for line in lines]
        rest = range(len(lines), len(lines) + len(self._quantities))
        group = np.array([*map(strengths.index, strengths), *rest])
        self.space = Space(group, np.arange(len(group)) >= len(lines))

    def vectors(self, points: Floats) -> Floats:
        """Rigs of the population at points ``(..., L, A)``, by their numbers ``(..., L, p)``."""
        along = points[..., len(self._lines) :]
        return self._mean + np.einsum("lpq,...lq->...lp", self._moves, along)

    def stressed(self, points: Floats) -> Stressed:
        """Plants of S points ``(S, L, A)``, each breath of a run, leaves ``(S * L, BREATHS, ...)``.

        Leaves are in NumPy.
        """
        if self._has_population:
            rigs: Any = from_vector(self.vectors(points), np)
        else:
            wide = points.shape[:2]
            rigs = jax.tree.map(lambda x: np.broadcast_to(x, wide + x.shape[1:]), self._plants)
        names = tuple(line.name for line in self._lines)
        each = []
        for k, lung in enumerate(self._lungs):
            shares = points[:, k, : len(names)].tolist()
            own = jax.tree.map(lambda leaf, k=k: leaf[:, k, None, None], rigs)
            conditions = [Condition(names, "strong", tuple(share)) for share in shares]
            each.append(stressed_plants(own, [lung], conditions))
        return jax.tree.map(lambda *x: np.stack(x, 1).reshape(-1, *x[0].shape[1:]), *each)

    def margin(self, points: Floats, pip: Floats) -> Floats:
        """Run points; see :data:`Margin`."""
        shape = points.shape[:-1]
        points, pip = points.reshape(-1, *points.shape[-2:]), np.broadcast_to(pip, shape)
        pip, parts = pip.reshape(len(points), -1), []
        for first in range(0, len(points), BATCH):
            # The last batch is padded, so that all compile once.
            at = np.minimum(np.arange(first, first + BATCH), len(points) - 1)
            parts.append(self._batch(points[at], pip[at]))
        return np.concatenate(parts)[: len(points)].reshape(shape)

    def _batch(self, points: Floats, pip: Floats) -> Floats:
        with compilation.float64():
            plants = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), self.stressed(points))
            scenario = nominal_scenario(pip.ravel())
            try:
                run = step_through(
                    by_breath(plants), scenario, self._runner, self._entry, self._tasks
                )
            except PlantError as error:  # such physics cannot be: the search goes round it
                broken = divmod(error.index, len(self._lungs))
                if not points[broken].any():
                    raise
                points = points.copy()
                points[broken] = 0.0
                excess = self._batch(points, pip)
                excess[broken] = -np.inf
                return excess
        # Of the fewest samples above the limit that fail a breath, the lowest; or the peak.
        forbidden = math.floor(protocol.SAFETY_TIME / protocol.DT + 1e-9) + 1
        falling = -np.sort(-run.breaths, axis=-1)
        excess = np.maximum(
            falling[..., forbidden - 1].max(axis=-1) - safety_limit(pip.ravel()),
            falling[..., 0].max(axis=-1) - protocol.SAFETY_CAP,
        )
        excess[[at for (at,) in run.failures]] = np.inf
        return excess.reshape(pip.shape)

    def physics(self, point: Floats, k: int) -> dict[str, str]:
        """What deviates at a point ``(L, A)`` in the last breath of a lung, by name."""
        said = {}
        for name, both in self.stressed(point[None]).physics.parameters().items():
            now, before = np.asarray(both)[k, -1]
            if now != before:
                said[name] = f"{now:.3g} instead of {before:.3g} {parameter(name).unit}"
        if self._quantities:
            ratios = np.exp(self.vectors(point) - self._mean)[k]
            for name in self._quantities:
                ratio = ratios[NAMES.index(name)]
                if abs(ratio - 1.0) > SHOWN:
                    said[f"{name} of the rig"] = f"x {ratio:.3g}"
        return said
